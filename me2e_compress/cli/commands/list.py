"""``me2e-compress list``."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import typer
from rich.markup import escape

from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.cli.console import console, print_json, table
from me2e_compress.driving.latency import LATENCY_SOURCES
from me2e_compress.driving.policies import POLICIES
from me2e_compress.errors import RecipeError
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.passes import PASSES
from me2e_compress.quantization.rules import RULE_SETS, RULES
from me2e_compress.registry import Entry, Option, Registry, describe
from me2e_compress.targets import TARGETS

KINDS: Mapping[str, Registry[Any]] = {
    "passes": PASSES,
    "rules": RULES,
    "rule-sets": RULE_SETS,
    "observers": OBSERVERS,
    "targets": TARGETS,
    "policies": POLICIES,
    "latency-sources": LATENCY_SOURCES,
    "evaluators": EVALUATORS,
}


def list_entries(
    kind: Annotated[str | None, typer.Argument(help=", ".join(KINDS))] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Show what can be named: ours, and what other packages add by entry point."""
    if kind is not None and kind not in KINDS:
        raise RecipeError(f"no kind {kind!r}; there are {', '.join(KINDS)}")
    chosen = KINDS if kind is None else {kind: KINDS[kind]}
    found = {name: describe(registry) for name, registry in chosen.items()}
    if as_json:
        print_json(found)
        return
    for name, entries in found.items():
        _show(f"{name} (entry points: {chosen[name].group})", entries, kind is not None)


def _show(title: str, entries: tuple[Entry, ...], closely: bool) -> None:
    """Print a table of entries; looked at closely, each option with its meaning."""
    shown = table(title, "name", "what it is", left=2)
    for entry in entries:
        lines = list(_lines(entry, closely))
        shown.add_row(escape(entry.name), "\n".join(lines))
    console.print(shown)


def _lines(entry: Entry, closely: bool) -> Iterator[str]:
    if entry.error:
        yield f"[red]{escape(entry.error)}[/red]"
        return
    theirs = "" if entry.source == "me2e-compress" else f" ({entry.source})"
    yield _plain(entry.doc + theirs)
    if closely:
        for option in entry.options:
            yield f"  [bold]{escape(_signature(option))}[/bold] {_plain(option.doc)}"
    elif entry.options:
        yield f"  [dim]{escape(', '.join(map(_assignment, entry.options)))}[/dim]"


def _plain(doc: str) -> str:
    return escape(doc.replace("`", ""))


def _assignment(option: Option) -> str:
    """Write an option as in text; one that must be given without a value."""
    return option.name if option.default is None else f"{option.name}={option.default}"


def _signature(option: Option) -> str:
    default = "" if option.default is None else f" = {option.default}"
    return f"{option.name}: {option.type}{default}"
