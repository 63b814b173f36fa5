"""The base class of fused operators; which one a node is, and in which dialect."""

import abc
import dataclasses
import functools
from collections.abc import Mapping
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.base.registry import Registry
from me2e_compress.graph.nodes import is_plugin, is_standard
from me2e_compress.graph.shapes import Dims, open_shape, product
from me2e_compress.graph.summary import total_bytes
from me2e_compress.graph.validity import PLUGIN_DOMAIN
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    OWN_DOMAIN,
    Arrays,
    Dialect,
    NdArray,
    Shapes,
    Values,
)


@dataclasses.dataclass(frozen=True)
class Cost:
    """The multiply-accumulates, and the bytes read and written, of a call if known."""

    macs: int | None
    bytes: int | None


@dataclasses.dataclass(frozen=True)
class Operator(abc.ABC):
    """A fused operator; subclasses are frozen dataclasses that are registered.

    Class attributes:
        name: its name in the registry and in reports.
        own: the toolkit's own form, in the domain ``me2e``.
        dialects: the known spellings of plugin libraries, the preferred of a name
            first.
        int8_inputs: indices of the inputs that may be int8, in the own form and every
            dialect: only features; positions and attention weights lose too much.
        output: the dimensions of the output in the own form: letters of the operands,
            integer attributes by name, and numbers.
        work: what to multiply for the multiply-accumulates of a call, likewise.
        opset: the first of ONNX's that its body is written in, 13 or later.
    """

    name: ClassVar[str]
    own: ClassVar[Dialect]
    dialects: ClassVar[tuple[Dialect, ...]]
    int8_inputs: ClassVar[tuple[int, ...]] = ()
    output: ClassVar[str] = ""
    work: ClassVar[str] = ""
    opset: ClassVar[int] = 13  # ReduceSum and Unsqueeze take their axes as inputs

    @abc.abstractmethod
    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write the operator in standard operators; return the own form's output."""

    @abc.abstractmethod
    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute the operator in the own form, in numpy and float64."""

    def output_shape(self, shapes: Shapes, attributes: Attributes) -> Dims | None:
        """Return the output's shape in the own form; unknown sizes are None."""
        # Nothing is known unless an operand that has one of its letters has a shape
        letters = set(self.output.split())
        pairs = zip(self.own.operands, shapes, strict=False)
        if not any(shape and letters & set(one.letters) for one, shape in pairs):
            return None
        return self._sizes(self.output, shapes, attributes)

    def macs(self, shapes: Shapes, attributes: Attributes) -> int | None:
        """Count the multiply-accumulates of a call in the own form, if known."""
        sizes = self._sizes(self.work, shapes, attributes)
        return product(sizes) if self.work else None

    def _sizes(self, dims: str, shapes: Shapes, attributes: Attributes) -> Dims:
        """Replace letters of operands and names of attributes by their sizes."""
        known = {k: value for k, value in attributes.items() if isinstance(value, int)}
        for operand, shape in zip(self.own.operands, shapes, strict=False):
            if shape is not None and operand.rank == len(shape):
                for letter, size in zip(operand.letters, shape, strict=True):
                    if size is not None:
                        known.setdefault(letter, size)
        return tuple(int(d) if d.isdigit() else known.get(d) for d in dims.split())

    def all_dialects(self) -> tuple[Dialect, ...]:
        """Return the own form, then every library's."""
        return (self.own, *self.dialects)

    def cost(self, node: ir.Node, dialect: Dialect) -> Cost:
        """Return the cost of one call as far as the shapes are known."""
        shapes = dialect.shapes_to_own([open_shape(value) for value in node.inputs])
        attributes = dialect.options_to_own(dialect.attributes_of(node))
        values = filter(None, (*node.inputs, node.outputs[0]))
        return Cost(self.macs(shapes, attributes), total_bytes(values))


_HERE = "me2e_compress.operators"

OPERATORS: Registry[Operator] = Registry(
    "operator",
    _HERE,
    RecipeError,
    {
        "deformable-attention": f"{_HERE}.deformable_attention:DeformableAttention",
        "deformable-aggregation": (
            f"{_HERE}.deformable_aggregation:DeformableAggregation"
        ),
        "rotate": f"{_HERE}.birds_eye_view:Rotate",
        "inverse": f"{_HERE}.inverse:Inverse",
        "grid-sampler-2d": f"{_HERE}.grid_sampler:GridSampler2D",
        "grid-sampler-3d": f"{_HERE}.grid_sampler:GridSampler3D",
        "select-and-pad": f"{_HERE}.select_and_pad:SelectAndPad",
        "bev-pool": f"{_HERE}.birds_eye_view:BEVPool",
        "multi-head-attention": f"{_HERE}.multi_head_attention:FusedMultiHeadAttention",
        "deformable-convolution": f"{_HERE}.convolutions:DeformableConvolution",
        "histogram": f"{_HERE}.histogram:Histogram",
    },
)

# Domains that define their operators; names there match no other dialect
RESERVED = (OWN_DOMAIN, "com.microsoft")


def find(node: ir.Node) -> tuple[Operator, Dialect] | None:
    """Return a node's fused operator and dialect; None if it is not one."""
    # TensorRT finds a plugin by the operator's name, and exporters put it in any domain
    # or none: so the name decides. Among several dialects of one name, the domain and
    # `plugin_version` decide, then the types and shapes of the node's inputs.
    rows = _rows().get(node.op_type)
    if rows is None or (is_standard(node) and not is_plugin(node)):
        return None
    # Reserved domains match only their own dialects
    domain = "" if is_standard(node) or node.domain == PLUGIN_DOMAIN else node.domain
    if domain in RESERVED:
        rows = [row for row in rows if row[1].domain == domain]
    else:
        rows = [row for row in rows if row[1].domain not in RESERVED]
    version = node.attributes.get_string("plugin_version", "1")
    return max(
        rows,
        key=lambda row: (
            row[1].domain == domain,
            row[1].version == version,
            _fits(row[1], node),
        ),
        default=None,
    )


def dialect_of(operator: Operator, name: str) -> Dialect | None:
    """Return an operator's dialect of this name, if there is one."""
    return next((d for d in operator.all_dialects() if d.name == name), None)


def dialect_names() -> tuple[str, ...]:
    """Return the names of all dialects, in the order of the operators."""
    return tuple(dict.fromkeys(dialect.name for _, dialect in _calls()))


@functools.cache
def operators() -> tuple[Operator, ...]:
    """Build every operator that can be imported, built-in ones first."""
    return tuple(OPERATORS.build(name, {}) for name in OPERATORS.usable())


@functools.cache
def op_types(name: str) -> frozenset[str]:
    """Return the node types of an operator in every dialect."""
    return frozenset(dialect.op_type for o, dialect in _calls() if o.name == name)


@functools.cache
def position_inputs() -> Mapping[str, tuple[int, ...]]:
    """Return the indices of inputs with positions or matrices to invert, by op_type."""
    operands = {op_type: rows[0][1].operands for op_type, rows in _rows().items()}
    return {
        op_type: tuple(i for i, operand in enumerate(row) if operand.positions)
        for op_type, row in operands.items()
    }


@functools.cache
def score_inputs() -> Mapping[str, int]:
    """Return the index of the input with weights before their softmax, by op_type."""
    return {
        op_type: index
        for op_type, rows in _rows().items()
        for index, operand in enumerate(rows[0][1].operands)
        if operand.scores
    }


def int8_inputs(node: ir.Node) -> tuple[int, ...]:
    """Return the indices of the inputs of a fused node that may be int8."""
    call = find(node) if node.op_type in int8_op_types() else None
    return () if call is None else call[0].int8_inputs


@functools.cache
def int8_op_types() -> frozenset[str]:
    """Return the op_types of fused operators that have int8 inputs."""
    return frozenset(
        op_type for op_type, rows in _rows().items() if rows[0][0].int8_inputs
    )


def _calls() -> list[tuple[Operator, Dialect]]:
    """Return every operator in every dialect."""
    return [
        (operator, dialect)
        for operator in operators()
        for dialect in operator.all_dialects()
    ]


@functools.cache
def _rows() -> dict[str, list[tuple[Operator, Dialect]]]:
    """Return operators and dialects by op_type."""
    rows: dict[str, list[tuple[Operator, Dialect]]] = {}
    for operator, dialect in _calls():
        rows.setdefault(dialect.op_type, []).append((operator, dialect))
    return rows


def _fits(dialect: Dialect, node: ir.Node) -> bool:
    """Return whether a node's inputs have the types and shapes of a dialect."""
    try:
        dialect.check(node)
    except PreconditionError:
        return False
    return True
