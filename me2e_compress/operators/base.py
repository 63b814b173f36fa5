"""What a fused operator is."""

import abc
import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph.shapes import Dims, open_shape
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import Arrays, Dialect, NdArray, Values


@dataclasses.dataclass(frozen=True)
class Cost:
    """What one call takes.

    Attributes:
        macs: multiply-accumulates; None where shapes are open.
        bytes: read and written, each operand and result once; None likewise.
    """

    macs: int | None
    bytes: int | None


@dataclasses.dataclass(frozen=True)
class Operator(abc.ABC):
    """A fused operator: derive a frozen dataclass, and register it.

    Class attributes:
        name: what registry and reports call it.
        own: the toolkit's own form, in the domain ``me2e``.
        dialects: every plugin library's spelling that is known, the preferred of a
            name first.
        int8_inputs: which inputs may be int8, of the own form and of every dialect:
            features alone; positions and attention weights lose too much.
    """

    name: ClassVar[str]
    own: ClassVar[Dialect]
    dialects: ClassVar[tuple[Dialect, ...]]
    int8_inputs: ClassVar[tuple[int, ...]] = ()

    @abc.abstractmethod
    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write the operator in standard operators, before the call's node.

        Args:
            call: where to write, and at which opset.
            inputs: in the own form.
            attributes: in the own form.

        Returns:
            The output in the own form.
        """

    @abc.abstractmethod
    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute the operator in the own form in numpy, in float64."""

    @abc.abstractmethod
    def output_shape(
        self, shapes: Sequence[Dims | None], attributes: Attributes
    ) -> Dims | None:
        """Return the shape of the output in the own form; None for open dimensions.

        Args:
            shapes: of the inputs in the own form; None for an unknown rank.
            attributes: in the own form.

        Returns:
            The shape; None if not even the rank is known.
        """

    @abc.abstractmethod
    def macs(self, shapes: Sequence[Dims | None], attributes: Attributes) -> int | None:
        """Count multiply-accumulates of a call in the own form; None if not known."""

    def all_dialects(self) -> tuple[Dialect, ...]:
        """List the own form, then every library's."""
        return (self.own, *self.dialects)

    def dialect_reference(
        self, dialect: Dialect, inputs: Arrays, attributes: Attributes
    ) -> NdArray:
        """Compute a call in a dialect in numpy, in float64."""
        own = dialect.arrays_to_own(inputs, attributes)
        result = self.reference(own, dialect.options_to_own(attributes))
        return dialect.result_from_own_array(result)

    def cost(self, node: ir.Node, dialect: Dialect) -> Cost:
        """Return what one call takes, as far as the shapes are known.

        Raises:
            PreconditionError: it has an attribute that this dialect does not know.
        """
        shapes = dialect.shapes_to_own([open_shape(value) for value in node.inputs])
        attributes = dialect.options_to_own(dialect.attributes_of(node))
        return Cost(
            self.macs(shapes, attributes), bytes_of((*node.inputs, node.outputs[0]))
        )


def bytes_of(values: Sequence[ir.Value | None]) -> int | None:
    """Add up the bytes of values; None if a shape or type is not known."""
    total = 0
    for value in values:
        if value is None:
            continue
        shape = open_shape(value)
        if shape is None or None in shape or value.dtype is None:
            return None
        count = math.prod(dim for dim in shape if dim is not None)
        total += math.ceil(count * value.dtype.itemsize)
    return total
