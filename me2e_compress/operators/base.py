"""The base class of fused operators."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph.shapes import Dims, open_shape, product
from me2e_compress.graph.summary import total_bytes
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import Arrays, Dialect, NdArray, Values


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
    """

    name: ClassVar[str]
    own: ClassVar[Dialect]
    dialects: ClassVar[tuple[Dialect, ...]]
    int8_inputs: ClassVar[tuple[int, ...]] = ()
    output: ClassVar[str] = ""
    work: ClassVar[str] = ""

    @abc.abstractmethod
    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write the operator in standard operators; return the own form's output."""

    @abc.abstractmethod
    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute the operator in the own form, in numpy and float64."""

    def output_shape(
        self, shapes: Sequence[Dims | None], attributes: Attributes
    ) -> Dims | None:
        """Return the output's shape in the own form, None for what is not known."""
        letters = set(self.output.split())
        pairs = zip(self.own.operands, shapes, strict=False)
        if not any(shape and letters & set(each.letters) for each, shape in pairs):
            return None
        return self._sizes(self.output, shapes, attributes)

    def macs(self, shapes: Sequence[Dims | None], attributes: Attributes) -> int | None:
        """Count the multiply-accumulates of a call in the own form, if known."""
        sizes = self._sizes(self.work, shapes, attributes)
        return product(sizes) if self.work else None

    def _sizes(
        self, dims: str, shapes: Sequence[Dims | None], attributes: Attributes
    ) -> Dims:
        """Return numbers for letters of operands, names of attributes and numbers."""
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

    def dialect_reference(
        self, dialect: Dialect, inputs: Arrays, attributes: Attributes
    ) -> NdArray:
        """Compute a call in a dialect, in numpy and float64."""
        own = dialect.arrays_to_own(inputs, attributes)
        result = self.reference(own, dialect.options_to_own(attributes))
        return dialect.result_from_own_array(result)

    def cost(self, node: ir.Node, dialect: Dialect) -> Cost:
        """Return the cost of one call as far as the shapes are known."""
        shapes = dialect.shapes_to_own([open_shape(value) for value in node.inputs])
        attributes = dialect.options_to_own(dialect.attributes_of(node))
        values = filter(None, (*node.inputs, node.outputs[0]))
        return Cost(self.macs(shapes, attributes), total_bytes(values))
