"""Targets describe the form of graph that a runtime requires.

To add a target, write its class, then add it to this table.
"""

import abc
import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import ClassVar, Literal, TypeAlias, get_args

import numpy as np
import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.base.registry import Registry
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import is_standard, opset_of
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, bodies, grid_of
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET, raise_opset
from me2e_compress.graph.validity import refusal
from me2e_compress.quantization.costs import Costs
from me2e_compress.quantization.decision import KeptFloat, QuantPlan
from me2e_compress.runtime.providers import CPU, Provider

__all__ = [
    "DEFAULT_TARGET",
    "TARGETS",
    "LintFinding",
    "LintRule",
    "Severity",
    "Target",
    "divided_grids",
    "error",
    "of_opset",
    "valid",
    "warning",
]

Severity = Literal["error", "wrong", "warning"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)  # the worst first


@dataclasses.dataclass(frozen=True)
class LintFinding:
    """One problem of a graph for its target.

    Attributes:
        severity: with ``error`` it is refused, with ``wrong`` computed otherwise, with
            ``warning`` slow, or in float.
        rule: id of the rule.
        node: name of the node; empty for a finding about the whole graph.
        message: what was found; and what is expected.
    """

    severity: Severity
    rule: str
    node: str
    message: str


# Inspects a graph whose shapes are inferred and yields findings
LintRule: TypeAlias = Callable[[ir.Model], Iterator[LintFinding]]


def error(rule: str, node: ir.Node | None, message: str) -> LintFinding:
    """Return a finding that makes the target refuse the graph."""
    return LintFinding("error", rule, name_of(node), message)


def warning(rule: str, node: ir.Node | None, message: str) -> LintFinding:
    """Return a finding with which the target still runs the graph, but badly."""
    return LintFinding("warning", rule, name_of(node), message)


def rule_of_nodes(
    rule: str,
    severity: Severity,
    nodes: Callable[[ir.Model], Iterable[ir.Node]] = graph.nodes_of,
) -> Callable[[Callable[[ir.Node], Iterator[str]]], LintRule]:
    """Make a rule of a function that yields what is wrong about one node."""

    def decorate(check: Callable[[ir.Node], Iterator[str]]) -> LintRule:
        def lint(model: ir.Model) -> Iterator[LintFinding]:
            for node in nodes(model):
                for message in check(node):
                    yield LintFinding(severity, rule, name_of(node), message)

        return lint

    return decorate


def valid(model: ir.Model) -> Iterator[LintFinding]:
    """Run ONNX's checker, ignoring plugins."""
    if reason := refusal(model, plugins=True):
        yield error("onnx", None, f"not valid ONNX: {reason}")


def worst_first(findings: Iterable[LintFinding]) -> tuple[LintFinding, ...]:
    """Sort findings by their severity."""
    return tuple(
        sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
    )


def of_opset(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators that are newer than the opset of the graph."""
    # TensorRT's parser does not look at the opset; onnxruntime does
    for part, opset in bodies(model):
        for node in part.all_nodes():
            name = node.op_type
            if not is_standard(node) or not onnx.defs.has(name, domain=""):
                continue
            if not onnx.defs.has(name, max_inclusive_version=opset, domain=""):
                since = min(
                    schema.since_version
                    for schema in onnx.defs.get_all_schemas_with_history()
                    if schema.name == name and schema.domain == ""
                )
                message = f"{name} came with opset {since}, the graph is of {opset}"
                yield error("operator-of-opset", node, message)


def divided_grids(model: ir.Model) -> Iterator[LintFinding]:
    """Find divisions by what may be 0 on the way to where GridSample samples."""
    # Points of depth 0 give 0 / 0 there
    visited, positive = set[ir.Node](), dict[ir.Value, bool]()
    for sampler in graph.nodes_of(model):
        # Walk back from the grid over what moves or combines positions
        pending = [grid_of(sampler)]
        while pending:
            node = graph.producer_of(pending.pop())
            if node is None or node in visited or node.op_type not in _TO_A_GRID:
                continue
            visited.add(node)
            pending += node.inputs
            divisor = node.inputs[-1]
            if node.op_type not in ("Div", "Reciprocal") or divisor is None:
                continue
            if graph.array_of(divisor) is None and not _is_positive(divisor, positive):
                message = (
                    f"{divisor.name}, by which it divides, may be 0, and"
                    f" {sampler.op_type} {name_of(sampler)!r} samples there: of NaN"
                    " onnxruntime 1.31 makes a pixel, OpenVINO NaN (measured); bound it"
                    " by Max or Clip"
                )
                yield warning("divided-grid", node, message)


_MOVES = LAYOUT_OPERATORS | {"Cast", "Expand", "Gather", "Slice", "Split", "Tile"}
_TO_A_GRID = _MOVES | {
    "Add", "Clip", "Concat", "Div", "Max", "Min", "Mul", "Neg", "Reciprocal", "Sub",
}  # fmt: skip
_POSITIVE = frozenset({"Exp", "Shape", "Sigmoid", "Size", "Softmax", "Softplus"})
_OF_POSITIVE = _MOVES | {"ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum", "Sqrt"}


def _is_positive(value: ir.Value | None, known: dict[ir.Value, bool]) -> bool:
    """Return whether a value is always above 0, by constants, bounds or terms added."""
    # One side that is positive guards an Add, a Max and a Where
    if (array := graph.array_of(value)) is not None:
        return bool(np.all(array.astype(np.float64) > 0))
    if value is None or (node := value.producer()) is None:
        return False
    if value not in known:
        kind, inputs = node.op_type, node.inputs
        sides = (_is_positive(side, known) for side in inputs)
        if kind == "Clip":
            low = node.attributes.get_float("min", 0.0)
            known[value] = low > 0 or _is_positive(graph.input_at(node, 1), known)
        elif kind in ("Add", "Max", "Where"):
            known[value] = any(sides)
        elif kind in ("Concat", "Div", "Min", "Mul", "Pow"):
            known[value] = all(sides)
        else:
            moved = kind in _OF_POSITIVE and _is_positive(inputs[0], known)
            known[value] = moved or kind in _POSITIVE
    return known[value]


def name_of(node: ir.Node | None) -> str:
    """Return what a finding calls a node: its name, or that of its first output."""
    return "" if node is None else node.name or str(node.outputs[0].name)


@dataclasses.dataclass(frozen=True)
class Target(abc.ABC):
    """A runtime of graphs: how int8 is written for it, and what it refuses.

    Derive a frozen dataclass; its fields are its options.

    Class attributes:
        name: its name in recipes and on the command line.
        half_since: the first opset in which it supports int8 in a float16 graph, with
            float16 scales; None if it has no such kernels.
        runs_in: name of the provider that runs its int8 on this machine, and in which
            :meth:`read_back` opens graphs; empty if there is none.
    """

    name: ClassVar[str]
    half_since: ClassVar[int | None] = None
    runs_in: ClassVar[str] = ""

    @abc.abstractmethod
    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """List the activations whose ranges :meth:`place` needs."""

    @abc.abstractmethod
    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Return a copy of a float graph in which a plan's nodes are int8.

        Raises:
            PreconditionError: the graph is older than opset 13 or in a float type
                without int8 here, or a planned weight is not constant.
            FramesError: the range of a tensor is missing.
        """

    def kept_float(self, plan: QuantPlan, model: ir.Model) -> tuple[KeptFloat, ...]:
        """List the plan's nodes that stay float in that copy, with the reasons."""
        return ()

    def fused_objection(self, node: ir.Node) -> str | None:
        """Explain why an operator with int8 inputs cannot read int8; None if it can."""
        return f"{self.name} has no int8 kernel for {node.op_type}"

    def check_types(self, plan: QuantPlan, model: ir.Model) -> None:
        """Check that the graph's opset and float type can be quantized.

        Raises:
            PreconditionError: the opset has no scales by channel, or target or opset
                nothing for float16; the message has a remedy.
        """
        if plan.chosen and opset_of(model) < OLDEST_OPSET:
            _, keeper = raise_opset(model.clone(), OLDEST_OPSET, "")
            keeper = keeper or "import-normalize behind the other passes lifts it"
            raise PreconditionError(
                f"int8 by channel needs opset {OLDEST_OPSET}, the graph is of"
                f" {opset_of(model)}: {keeper}; -r exact writes a graph without int8"
            )
        # Float16 needs kernels, and scales of that type
        types = {v.name: v.dtype for node in model.graph for v in node.outputs}
        halves = [d for d in plan.chosen if types[d.output] == ir.DataType.FLOAT16]
        opset, since = opset_of(model), self.half_since
        if not halves or (since is not None and since <= opset):
            return
        reason = f"{self.name} has int8 kernels for float32 alone"
        if since is not None:
            reason = f"float16 scales need opset {since}, the graph is of {opset}"
        raise PreconditionError(
            f"{halves[0].node or halves[0].output} and {len(halves) - 1} more layers"
            f" are in float16, and {reason}: put convert-float32 before quantize-int8"
            " (--passes import-normalize,convert-float32,fuse-basic,quantize-int8)"
        )

    def costs(self, model: ir.Model, layers: Collection[ir.Node]) -> Costs | None:
        """Estimate what int8 of layers saves and costs; None if unknown."""
        return None

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Return the target's lint rules."""
        return ()

    def lint(self, model: ir.Model) -> tuple[LintFinding, ...]:
        """List all findings of a graph, errors first; the graph is not changed."""
        # The rules need inferred shapes.
        copy = model.clone()
        copy.meta.update(model.meta)  # what the file is, beside what was read of it
        graph.infer_shapes(copy)
        findings = [finding for rule in self.lint_rules() for finding in rule(copy)]
        return worst_first(findings)

    def read_back(
        self, model: ir.Model, provider: Provider = CPU
    ) -> tuple[LintFinding, ...]:
        """Open a graph, and list what runs differently from its types; errors first.

        The graph must pass :meth:`lint` without errors. A target without a runtime here
        finds nothing.
        """
        return ()


_HERE = "me2e_compress.targets"

# For whom int8 is written where nobody is named: who runs it on this machine
DEFAULT_TARGET = "onnxruntime"

TARGETS: Registry[Target] = Registry(
    "target",
    _HERE,
    RecipeError,
    {
        "tensorrt": f"{_HERE}.tensorrt:TensorRT",
        "onnxruntime": f"{_HERE}.onnxruntime:OnnxRuntime",
        "openvino": f"{_HERE}.openvino:OpenVino",
    },
)
