"""Overrides: a TOML file of exceptions to a plan, which the user decides.

TOML::

    [[override]]
    nodes = "/head/decoder/*"     # glob over node names; * also crosses a slash
    module = "planner"            # all that are given must hold
    op = "MatMul"
    reads = "/neck/out"           # glob over the tensors that they read: a whole group
    dtype = "float"               # or "int8"
    reason = "costs 3 dB"         # may be left out

    [[concat]]
    nodes = "/neck/Concat*"       # scales of what these join stay apart
    scale = "own"

Names are those of the nodes when they are quantized, or of the nodes of the source file
that they stand for. Where two overrides match a node, the later counts.
"""

import dataclasses
import fnmatch
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, Self

import onnx_ir as ir
import pydantic

from me2e_compress.errors import RecipeError
from me2e_compress.graph import provenance
from me2e_compress.quantization.plan.decision import FLOAT, INT8, Decision
from me2e_compress.registry import documents
from me2e_compress.registry.documents import toml_string

_GLOB = str.maketrans({"[": "[[]", "?": "[?]", "*": "[*]"})
"""Makes a name a pattern that matches only itself."""

_UNSUPPORTED = "only int8 and float are supported (no int4, fp8 or mixed 16 bit)"


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Override(_Strict):
    """One exception: which nodes, and their dtype."""

    dtype: str
    nodes: str | None = None
    module: str | None = None
    op: str | None = None
    reads: str | None = None
    reason: str = ""

    @pydantic.model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.dtype not in (INT8, FLOAT):
            raise ValueError(f"dtype {self.dtype}: {_UNSUPPORTED}")
        if not self._given():
            raise ValueError("none of nodes, module, op and reads is given")
        return self

    def matches(self, node: ir.Node, names: Sequence[str] | None = None) -> bool:
        """Return whether it applies to a node.

        ``names`` are the node's own and its origins'; None looks them up.
        """
        return (
            (self.op is None or node.op_type == self.op)
            and (self.module is None or provenance.module_of(node) == self.module)
            and (self.nodes is None or _named(names or _names(node), self.nodes))
            and (self.reads is None or _reads(node, self.reads))
        )

    @property
    def why(self) -> str:
        """The reason that the user gave, else the override itself."""
        return self.reason or f"override: {self}"

    def __str__(self) -> str:
        return ", ".join(f"{key} {value!r}" for key, value in self._given().items())

    def _given(self) -> dict[str, str]:
        keys = ("nodes", "module", "op", "reads")
        return {k: text for k in keys if (text := getattr(self, k)) is not None}


def keep_float(name: str, reason: str) -> Override:
    """Return the override that keeps one node in float."""
    return Override(dtype=FLOAT, nodes=name.translate(_GLOB), reason=reason)


def keep_readers(tensor: str, reason: str) -> Override:
    """Return the override that keeps all readers of a tensor in float."""
    return Override(dtype=FLOAT, reads=tensor.translate(_GLOB), reason=reason)


def overrides_text(overrides: Iterable[Override]) -> str:
    """Write overrides as the TOML that ``--overrides`` reads."""
    entries = []
    for each in overrides:
        keys = ("nodes", "module", "op", "reads", "dtype", "reason")
        given = {key: text for key in keys if (text := getattr(each, key))}
        lines = (f"{key} = {toml_string(text)}\n" for key, text in given.items())
        entries.append("[[override]]\n" + "".join(lines))
    return "\n".join(entries)


class ConcatScale(_Strict):
    """Concats whose inputs keep scales of their own."""

    nodes: str
    scale: Literal["own"]


class Overrides(_Strict):
    """A file of exceptions."""

    override: tuple[Override, ...] = ()
    concat: tuple[ConcatScale, ...] = ()

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file.

        Raises:
            RecipeError: no such file, not TOML, or not overrides.
        """
        if not path.is_file():
            raise RecipeError(f"{path}: no such file of overrides")
        with documents.reading(path, RecipeError, "not TOML"):
            content = documents.content(path)
        return cls.parse(content, str(path))

    @classmethod
    def parse(cls, text: str | bytes, origin: str = "overrides") -> Self:
        """Read TOML; ``origin`` is its name in error messages."""
        with documents.reading(origin, RecipeError, "not TOML"):
            content = documents.from_toml(text)
        with documents.reading(origin, RecipeError, "not overrides"):
            return cls.model_validate(content)

    def bind(self, model: ir.Model) -> "Pins":
        """Find the nodes of a graph that they apply to.

        Raises:
            RecipeError: an override matches nothing.
        """
        main = {node: _names(node) for node in model.graph}
        # the last override that matches a node wins
        pinned: dict[ir.Node, Override] = {}
        for each in self.override:
            pinned.update(dict.fromkeys(_some(main, each.matches, str(each)), each))
        # Concats whose scales stay apart
        apart: dict[ir.Node, None] = {}
        for rule in self.concat:

            def joined(
                node: ir.Node, names: Sequence[str], glob: str = rule.nodes
            ) -> bool:
                return node.op_type == "Concat" and _named(names, glob)

            apart.update(dict.fromkeys(_some(main, joined, f"concat {rule.nodes!r}")))
        return Pins(pinned, frozenset(apart))


NONE = Overrides()


@dataclasses.dataclass(frozen=True)
class Pins:
    """Overrides bound to the nodes of one graph.

    ``apart`` holds the Concats whose inputs keep scales of their own.
    """

    pinned: Mapping[ir.Node, Override]
    apart: frozenset[ir.Node]

    def get(self, node: ir.Node) -> Override | None:
        """Return the user's decision for a node, if any."""
        return self.pinned.get(node)

    def check(self, decided: Mapping[ir.Node, Decision]) -> None:
        """Refuse overrides to int8 that no node could follow.

        The RecipeError names the override and why its first node cannot be int8.
        """
        # overrides to int8 that some node follows, and those that one refuses
        refused: dict[Override, Decision] = {}
        followed: dict[Override, None] = {}
        for node, override in self.pinned.items():
            if override.dtype != INT8:
                continue
            if decided[node].dtype == INT8:
                followed[override] = None
            else:
                refused.setdefault(override, decided[node])
        # an override that nobody follows is a fault
        for override, decision in refused.items():
            if override not in followed:
                raise RecipeError(
                    f"override {override}: {decision.node or decision.output} cannot"
                    f" be int8: {decision.reason}"
                )


def _names(node: ir.Node) -> tuple[str, ...]:
    past = provenance.read(node)
    return (node.name or "", *(past.origins if past is not None else ()))


def _named(names: Sequence[str], glob: str) -> bool:
    return any(fnmatch.fnmatchcase(name, glob) for name in names)


def _reads(node: ir.Node, glob: str) -> bool:
    names = (str(value.name) for value in node.inputs if value is not None)
    return any(fnmatch.fnmatchcase(name, glob) for name in names)


def _some(
    nodes: Mapping[ir.Node, Sequence[str]],
    matches: Callable[[ir.Node, Sequence[str]], bool],
    what: str,
) -> list[ir.Node]:
    found = [node for node, names in nodes.items() if matches(node, names)]
    if not found:
        raise RecipeError(f"override {what} matches none of {len(nodes)} nodes")
    return found
