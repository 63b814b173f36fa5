"""The plan: a decision for every node; on disk and in a model."""

import dataclasses
import fnmatch
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Self

import onnx_ir as ir
import pydantic

from me2e_compress.base import documents
from me2e_compress.base.atomic import write_document
from me2e_compress.base.display import Table, table
from me2e_compress.base.documents import toml_string
from me2e_compress.base.errors import ModuleMapError, RecipeError
from me2e_compress.graph import WEIGHTED, provenance
from me2e_compress.graph.modules.module_map import ModuleMap, Role
from me2e_compress.operators import int8_op_types

SCHEMES: dict[str, tuple[Role, ...]] = {
    "feature-ext": ("feature",),
    "prediction": ("prediction",),
    "full": ("feature", "prediction"),
}
"""The three schemes of the paper (Table 4): the feature extraction is backbone, neck
and BEV encoder, the prediction every other functional module, full their union."""


@dataclasses.dataclass(frozen=True)
class QuantScheme:
    """A named choice of modules.

    ``name`` is ``modules`` if the modules were listed one by one.
    """

    name: str
    modules: tuple[str, ...]

    @classmethod
    def named(cls, name: str, modules: ModuleMap) -> Self:
        """Return the modules of a map whose roles a scheme names.

        A scheme of one role needs a map that has modules of both.

        Raises:
            RecipeError: no such scheme; int4 and fp8 are none.
            ModuleMapError: the map has modules of one role only.
        """
        if name not in SCHEMES:
            raise RecipeError(
                f"no scheme {name}; there are {', '.join(SCHEMES)}, all of them int8"
            )
        wanted = SCHEMES[name]
        # a scheme of a part needs a map that knows parts
        lacking = [role for role in SCHEMES["full"] if not modules.names(role)]
        if lacking and name != "full":
            raise ModuleMapError(
                f"scheme {name} is of a part of the graph, and map {modules.name}"
                f" ({', '.join(modules.names())}) has no module of role {lacking[0]}:"
                " name a map that has (--map), or take scheme full"
            )
        chosen = (module.name for module in modules.modules if module.role in wanted)
        return cls(name, tuple(chosen))

    @classmethod
    def of(cls, chosen: str | tuple[str, ...], modules: ModuleMap) -> Self:
        """Return the scheme of a name, or of modules that are listed."""
        if isinstance(chosen, str):
            return cls.named(chosen, modules)
        for name in chosen:
            modules.module(name)
        return cls("modules", tuple(n for n in modules.names() if n in chosen))


METADATA = "me2e.quant_plan"
"""Key of the model's metadata under which a quantized graph carries its plan."""

INT8 = "int8"
FLOAT = "float"
RESIDUAL = "residual"
Shape = tuple[int, ...] | None


@dataclasses.dataclass(frozen=True)
class Decision:
    """The decision for one node.

    Attributes:
        node: its name, which need not be unique.
        output: name of its first output, which is unique.
        op: its operator.
        module: its ME2E module; empty if unknown.
        dtype: ``int8`` or ``float``.
        rule: id of the rule that decided; for int8 ``layer``, ``attention``,
            ``sampled`` or ``residual``; ``override`` if the user did.
        reason: the same in words.
        shapes: of the first two inputs and the first output; None if open.
        activations: which inputs get an activation scale. Of an Add it is one, the
            residual branch: the other comes out of a convolution that it is fused with.
        weight: which input is stored as int8; None if none is.
        axis: axis of the weight's per-channel scales; None for one scale in all, as a
            batch of matrices has.
    """

    node: str
    output: str
    op: str
    module: str
    dtype: str
    rule: str
    reason: str
    shapes: tuple[Shape, ...]
    activations: tuple[int, ...] = ()
    weight: int | None = None
    axis: int | None = None

    @property
    def could_be_int8(self) -> bool:
        """Whether it is int8, or of a kind that may be."""
        return self.dtype == INT8 or self.op in WEIGHTED or self.op in int8_op_types()


@dataclasses.dataclass(frozen=True)
class ScaleGroup:
    """Inputs and result of a Concat, which are on one scale where they can be.

    Attributes:
        name: name of the Concat.
        tensors: the activations on one scale.
        nodes: names of the nodes that read them in int8.
    """

    name: str
    tensors: tuple[str, ...]
    nodes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class KeptFloat:
    """A node that is int8 in a plan but float on one target.

    ``output`` is the name of its first output, ``reason`` what the target lacks.
    """

    node: str
    output: str
    reason: str


@dataclasses.dataclass(frozen=True, repr=False)
class QuantPlan:
    """Decisions for every node of a graph, in graph order; the same for all targets.

    Attributes:
        scheme: the modules that are to be int8.
        decisions: one per node.
        rules: name of the rule set.
        groups: what Concats join.
        kept_float: int8 nodes that stay float on the target; empty before the plan was
            carried out for one.
        balanced: whether weights are rounded so that their errors cancel, and lopsided
            activations span uint8.
        target: who is to run the graph; empty where the plan was made for nobody.
    """

    scheme: QuantScheme
    decisions: tuple[Decision, ...]
    rules: str = "paper"
    groups: tuple[ScaleGroup, ...] = ()
    kept_float: tuple[KeptFloat, ...] = ()
    balanced: bool = False
    target: str = ""

    @property
    def chosen(self) -> tuple[Decision, ...]:
        """The nodes that read int8: layers, attention products, residual Adds."""
        return tuple(decision for decision in self.decisions if decision.dtype == INT8)

    @property
    def placed(self) -> tuple[Decision, ...]:
        """Those of the chosen nodes that are int8 in the graph for the target."""
        left = {node.output for node in self.kept_float}
        return tuple(node for node in self.chosen if node.output not in left)

    @property
    def headline(self) -> str:
        """Count int8, by rule."""
        counts = ", ".join(f"{rule} {count}" for rule, count in self.counts().items())
        kept = len(self.kept_float)
        why = "; ".join(dict.fromkeys(node.reason for node in self.kept_float))
        return (
            f"scheme {self.scheme.name}, rules {self.rules}"
            + (f", for {self.target}" if self.target else "")
            + f": {len(self.chosen)} of"
            f" {len(self.decisions)} nodes int8{counts and '; '}{counts}"
            + (f"; {kept} of them stay float on their target: {why}" if kept else "")
        )

    def tables(self) -> tuple[Table, ...]:
        """Return how many nodes of a module are int8 or float; nodes as in `counts`."""
        could = [decision for decision in self.decisions if decision.could_be_int8]
        rows = list[tuple[str, ...]]()
        for module in dict.fromkeys(decision.module for decision in could):
            theirs = [decision for decision in could if decision.module == module]
            left = Counter(node.rule for node in theirs if node.dtype != INT8)
            rules = ", ".join(f"{rule} {left[rule]}" for rule in sorted(left))
            counts = len(theirs) - left.total(), left.total()
            rows.append((module, rules, *map(str, counts)))
        columns = ("module", "float by rule", "int8", "float")
        return (table("Decisions by module and rule", columns, rows, words=2),)

    def counts(self) -> dict[str, int]:
        """Count the decisions by rule, over the nodes that could be int8 at all."""
        rules = Counter(node.rule for node in self.decisions if node.could_be_int8)
        return dict(sorted(rules.items()))


def save_plan(plan: QuantPlan, path: Path) -> None:
    """Write a plan as JSON, all or nothing."""
    write_document(path, dataclasses.asdict(plan), indent=1)


def load_plan(path: Path) -> QuantPlan:
    """Read the result of :func:`save_plan`.

    Raises:
        RecipeError: no such file, or not a plan.
    """
    if not path.is_file():
        raise RecipeError(f"{path}: no such plan")
    with documents.reading(path, RecipeError, "not a plan"):
        return pydantic.TypeAdapter(QuantPlan).validate_json(documents.read_bytes(path))


def stamp_plan(model: ir.Model, plan: QuantPlan) -> None:
    """Write a plan into a model's metadata."""
    text = json.dumps(dataclasses.asdict(plan), separators=(",", ":"))
    model.metadata_props[METADATA] = provenance.compressed(text)


def plan_of(model: ir.Model) -> QuantPlan | None:
    """Read the plan that a model was quantized by; None if it carries none.

    Raises:
        RecipeError: what it carries is not a plan.
    """
    text = model.metadata_props.get(METADATA)
    if text is None:
        return None
    with documents.reading(
        "the plan in the model's metadata", RecipeError, "not a plan"
    ):
        return pydantic.TypeAdapter(QuantPlan).validate_json(
            provenance.decompressed(text)
        )


# Overrides: a TOML file of exceptions to a plan, which the user decides.
#
#    [[override]]
#    nodes = "/head/decoder/*"     # glob over node names; * also crosses a slash
#    module = "planner"            # all that are given must hold
#    op = "MatMul"
#    reads = "/neck/out"           # glob over the tensors that they read: a whole group
#    dtype = "float"               # or "int8"
#    reason = "costs 3 dB"         # may be left out
#
# Names are those of the nodes when they are quantized, or of the nodes of the source
# file that they stand for. Where two overrides match a node, the later counts.


# Makes a name a pattern that matches only itself.
_GLOB = str.maketrans({"[": "[[]", "?": "[?]", "*": "[*]"})

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
        if not str(self):
            raise ValueError("none of nodes, module, op and reads is given")
        return self

    def matches(self, node: ir.Node, names: Sequence[str]) -> bool:
        """Return whether it applies to a node of these names: its own, its origins'."""
        tensors = [str(value.name) for value in node.inputs if value is not None]
        return (
            (self.op is None or node.op_type == self.op)
            and (self.module is None or provenance.module_of(node) == self.module)
            and (self.nodes is None or _matches_any(names, self.nodes))
            and (self.reads is None or _matches_any(tensors, self.reads))
        )

    @property
    def why(self) -> str:
        """The reason that the user gave, else the override itself."""
        return self.reason or f"override: {self}"

    def __str__(self) -> str:
        fields = {key: getattr(self, key) for key in ("nodes", "module", "op", "reads")}
        return ", ".join(
            f"{k} {text!r}" for k, text in fields.items() if text is not None
        )


def keep_float(name: str, reason: str) -> Override:
    """Return the override that keeps one node in float."""
    return Override(dtype=FLOAT, nodes=name.translate(_GLOB), reason=reason)


def keep_readers(tensor: str, reason: str) -> Override:
    """Return the override that keeps all readers of a tensor in float."""
    return Override(dtype=FLOAT, reads=tensor.translate(_GLOB), reason=reason)


def overrides_text(overrides: Iterable[Override]) -> str:
    """Write overrides as the TOML that ``--overrides`` reads."""
    entries = []
    for override in overrides:
        keys = ("nodes", "module", "op", "reads", "dtype", "reason")
        fields = {key: text for key in keys if (text := getattr(override, key))}
        lines = (f"{key} = {toml_string(text)}\n" for key, text in fields.items())
        entries.append("[[override]]\n" + "".join(lines))
    return "\n".join(entries)


class Overrides(_Strict):
    """A file of exceptions."""

    override: tuple[Override, ...] = ()

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file.

        Raises:
            RecipeError: no such file, not TOML, or not overrides.
        """
        if not path.is_file():
            raise RecipeError(f"{path}: no such file of overrides")
        with documents.reading(path, RecipeError, "not TOML"):
            content = documents.read_bytes(path)
        return cls.parse(content, str(path))

    @classmethod
    def parse(cls, text: str | bytes, origin: str = "overrides") -> Self:
        """Read TOML; ``origin`` is its name in error messages."""
        with documents.reading(origin, RecipeError, "not TOML"):
            content = documents.from_toml(text)
        with documents.reading(origin, RecipeError, "not overrides"):
            return cls.model_validate(content)

    def bind(self, model: ir.Model) -> Mapping[ir.Node, Override]:
        """Map the nodes of a graph to the override that applies to them.

        Raises:
            RecipeError: an override matches nothing.
        """
        # A node goes by its own name and by those of its origins
        main: dict[ir.Node, tuple[str, ...]] = {}
        for node in model.graph:
            past = provenance.read(node)
            origins = () if past is None else past.origins
            main[node] = (node.name or "", *origins)
        pinned: dict[ir.Node, Override] = {}
        for override in self.override:
            nodes = [n for n, names in main.items() if override.matches(n, names)]
            if not nodes:
                raise RecipeError(
                    f"override {override} matches none of {len(main)} nodes"
                )
            pinned.update(dict.fromkeys(nodes, override))  # the last that matches wins
        return pinned


NONE = Overrides()


def check_followed(
    pinned: Mapping[ir.Node, Override], decided: Mapping[ir.Node, Decision]
) -> None:
    """Refuse overrides to int8 that no node could follow.

    The RecipeError names the override and why its first node cannot be int8.
    """
    # overrides to int8 that some node follows, and those that one refuses
    refused: dict[Override, Decision] = {}
    followed: dict[Override, None] = {}
    for node, override in pinned.items():
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


def _matches_any(names: Sequence[str], glob: str) -> bool:
    return any(fnmatch.fnmatchcase(name, glob) for name in names)
