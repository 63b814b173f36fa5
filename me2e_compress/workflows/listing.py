"""List everything that can be named, with what other packages add by entry point."""

import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.recording import LOGS
from me2e_compress.driving.host_stage import HOST_STAGES
from me2e_compress.driving.input_sources import INPUT_SOURCES
from me2e_compress.driving.latency import LATENCY_SOURCES
from me2e_compress.driving.policies import POLICIES
from me2e_compress.driving.shipped_adapters import adapter_file, shipped_adapters
from me2e_compress.errors import RecipeError
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.graph import modules
from me2e_compress.operators import OPERATORS
from me2e_compress.passes import PASSES
from me2e_compress.quantization.rules import RULE_SETS, RULES
from me2e_compress.registry import Entry, Option, Registry, describe
from me2e_compress.runtime.energy.energy_counter import ENERGY_COUNTERS
from me2e_compress.runtime.providers import PROVIDERS
from me2e_compress.shipped.drivers import SHIPPED
from me2e_compress.targets import TARGETS
from me2e_compress.workflows.result import Result, Table, table

_OURS = "me2e-compress"
_COMMENT = re.compile(r"(?:#.*\n)+")
_SENTENCE = re.compile(r"(.+?\.)(?:\s|$)")


@dataclasses.dataclass(frozen=True, repr=False)
class ListResult(Result):
    """Names by kind, with descriptions; `closely` shows what each option means."""

    kinds: Mapping[str, tuple[Entry, ...]]
    closely: bool = False

    @property
    def headline(self) -> str:
        """The number of names of each kind."""
        return ", ".join(f"{len(found)} {kind}" for kind, found in self.kinds.items())

    def lines(self) -> tuple[str, ...]:
        """Return no line: the tables say everything."""
        return ()

    def tables(self) -> tuple[Table, ...]:
        """Return one table per kind: names, descriptions and options."""
        return tuple(
            table(
                kind,
                ("name", "what it is"),
                [row for each in found for row in _rows(each, self.closely)],
                _added_to(kind),
                words=2,
            )
            for kind, found in self.kinds.items()
        )

    def to_json(self) -> object:
        """Return the entries by kind."""
        return self.kinds


def _registered(kind: str) -> tuple[Entry, ...]:
    return describe(REGISTRIES[kind])


def _recipes() -> tuple[Entry, ...]:
    found = resources.files("me2e_compress").joinpath("recipes").iterdir()
    files = sorted(found, key=lambda path: path.name.removesuffix(".toml"))
    return tuple(_file(path) for path in files if path.name.endswith(".toml"))


def _adapters() -> tuple[Entry, ...]:
    return tuple(_file(adapter_file(Path(name))) for name in shipped_adapters())


def _module_maps() -> tuple[Entry, ...]:
    maps = [modules.ModuleMap.load(name) for name in (*modules.presets(), "whole")]
    return tuple(Entry(each.name, _OURS, ", ".join(each.names())) for each in maps)


def _stacks() -> tuple[Entry, ...]:
    words = "trained; ships with the package"
    return tuple(Entry(name, _OURS, words) for name in SHIPPED)


def _file(path: Traversable) -> Entry:
    """Describe a TOML file by the first sentence of the comment at its head."""
    found = _COMMENT.match(path.read_text(encoding="utf-8"))
    text = " ".join((found.group() if found else "").replace("#", " ").split())
    sentence = _SENTENCE.match(text)
    doc = sentence[1] if sentence else text
    return Entry(path.name.removesuffix(".toml"), _OURS, doc)


REGISTRIES: Mapping[str, Registry[Any]] = {
    "passes": PASSES,
    "rules": RULES,
    "rule-sets": RULE_SETS,
    "observers": OBSERVERS,
    "logs": LOGS,
    "targets": TARGETS,
    "policies": POLICIES,
    "latency-sources": LATENCY_SOURCES,
    "energy-counters": ENERGY_COUNTERS,
    "host-stages": HOST_STAGES,
    "input-sources": INPUT_SOURCES,
    "evaluators": EVALUATORS,
    "providers": PROVIDERS,
    "operators": OPERATORS,
}
"""Registries to which other packages add."""
KINDS: Mapping[str, Callable[[], tuple[Entry, ...]]] = {
    **{kind: partial(_registered, kind) for kind in REGISTRIES},
    "recipes": _recipes,
    "adapters": _adapters,
    "module-maps": _module_maps,
    "stacks": _stacks,
}
"""The functions that find the entries of a kind."""


def list_entries(kind: str | None = None) -> ListResult:
    """List what can be named, of one kind (with every option's meaning) or of all.

    Raises:
        RecipeError: There is no such kind.
    """
    if kind is not None and kind not in KINDS:
        raise RecipeError(f"no kind {kind!r}; there are {', '.join(KINDS)}")
    # options are only explained for a single kind, since all would be long
    chosen = KINDS if kind is None else {kind: KINDS[kind]}
    return ListResult({name: find() for name, find in chosen.items()}, kind is not None)


def _added_to(kind: str) -> str:
    found = REGISTRIES.get(kind)
    return (
        ""
        if found is None
        else f"other packages add theirs by entry point: {found.group}"
    )


def _rows(entry: Entry, closely: bool) -> Iterator[tuple[str, str]]:
    """Yield the name with its description, then the options on rows of their own."""
    theirs = "" if entry.source == _OURS else f" ({entry.source})"
    yield entry.name, entry.error or _words(entry.doc + theirs)
    if closely:
        yield from (("", _words(f"{_signature(e)} {e.doc}")) for e in entry.options)
    elif entry.options:
        yield "", _words(", ".join(map(_assignment, entry.options)))


def _words(text: str) -> str:
    return text.replace("`", "")


def _assignment(option: Option) -> str:
    return option.name if option.default is None else f"{option.name}={option.default}"


def _signature(option: Option) -> str:
    default = "" if option.default is None else f" = {option.default}"
    return f"{option.name}: {option.type}{default}"
