"""A dialect of a fused operator: how one plugin library spells it."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.graph.nodes import input_at
from me2e_compress.graph.shapes import Dims, open_shape
from me2e_compress.operators.call import Attributes, AttributeValue, FusedCall

OWN_DOMAIN = "me2e"
"""The domain of the toolkit's own form of every fused operator, opset 1."""

NdArray: TypeAlias = npt.NDArray[Any]
Arrays: TypeAlias = Sequence[NdArray | None]
Values: TypeAlias = Sequence[ir.Value | None]

FLOATS = (ir.DataType.FLOAT, ir.DataType.FLOAT16)
FLOAT32 = (ir.DataType.FLOAT,)
INT8_TOO = (*FLOATS, ir.DataType.INT8)
INT32 = (ir.DataType.INT32,)
INTEGERS = (ir.DataType.INT32, ir.DataType.INT64)

PLUGIN_ATTRIBUTES = ("plugin_version", "plugin_namespace")
"""What TensorRT finds a plugin by besides the operator's name; of no other meaning."""


@dataclasses.dataclass(frozen=True)
class Operand:
    """One input of a fused operator.

    Attributes:
        name: what messages call it.
        dims: its dimensions, parted by blanks: a number, a letter that stands for one
            size in all operands of a call, or ``*`` for any; None for any rank.
        types: the element types that are taken.
        optional: whether it may be left out, it and all behind it.
        positions: whether it says where to look, or which matrix to invert: such
            numbers stay in float.
        scores: whether it holds weights before their softmax.
    """

    name: str
    dims: str | None = None
    types: tuple[ir.DataType, ...] = FLOATS
    optional: bool = False
    positions: bool = False
    scores: bool = False

    @property
    def rank(self) -> int | None:
        """How many dimensions it has; None where any number is taken."""
        return None if self.dims is None else len(self.dims.split())

    def takes(self, kind: ir.DataType | None) -> bool:
        """Return whether an element type is taken; float64 is wherever float32 is."""
        if kind == ir.DataType.DOUBLE:
            kind = ir.DataType.FLOAT
        return kind is None or kind in self.types


@dataclasses.dataclass(frozen=True)
class Attribute:
    """One attribute of a fused operator.

    Attributes:
        name: as it stands in the file.
        default: what is written where a conversion knows none; of its type.
        required: whether the plugin refuses a node without it.
        choices: the values that are allowed; empty for any.
    """

    name: str
    default: int | float | str | tuple[int, ...]
    required: bool = True
    choices: tuple[int | str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Dialect:
    """How one library spells an operator; as it stands, it takes the own form's inputs.

    Derive from it where inputs, attributes or the output are laid out otherwise:
    ``inputs_*`` and ``result_*`` write the conversions as nodes, ``options_*`` convert
    attributes, ``shape*`` shapes, and those with ``array`` in their names do it in
    numpy, for the reference.

    Attributes:
        name: what ``translate-plugins`` and ``--dialect`` call it.
        op_type: the operator's name in a file.
        domain: where exporters put it.
        operands: its inputs in order.
        source: the library, for messages.
        attributes: those that it takes besides ``plugin_version`` and
            ``plugin_namespace``.
        version: ``plugin_version`` that TensorRT looks for.
        namespace: ``plugin_namespace`` that TensorRT looks for.
        int8_scale: which input holds the scales of int8 features, float32, one a
            channel; None where no input does.
    """

    name: str
    op_type: str
    domain: str
    operands: tuple[Operand, ...]
    source: str = ""
    attributes: tuple[Attribute, ...] = ()
    version: str = "1"
    namespace: str = ""
    int8_scale: int | None = None

    def inputs_to_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write what turns this dialect's inputs into the own form's."""
        return inputs

    def inputs_from_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write what turns the own form's inputs into this dialect's."""
        kinds = dict(zip((each.name for each in self.operands), inputs, strict=False))
        return self.in_types(call, kinds)

    def options_to_own(self, attributes: Attributes) -> Attributes:
        """Turn this dialect's attributes into the own form's."""
        return attributes

    def options_from_own(self, attributes: Attributes) -> Attributes:
        """Turn the own form's attributes into this dialect's."""
        return attributes

    def result_to_own(self, call: FusedCall, result: ir.Value, own: Values) -> ir.Value:
        """Write what turns this dialect's output into the own form's.

        Args:
            call: where to write.
            result: the output.
            own: the inputs in the own form.
        """
        return result

    def result_from_own(
        self, call: FusedCall, result: ir.Value, own: Values
    ) -> ir.Value:
        """Write what turns the own form's output into this dialect's."""
        return result

    def arrays_to_own(self, arrays: Arrays, attributes: Attributes) -> Arrays:
        """Turn this dialect's inputs into the own form's, in numpy."""
        return arrays

    def result_from_own_array(self, result: NdArray) -> NdArray:
        """Turn the own form's output into this dialect's, in numpy."""
        return result

    def shape_from_own(self, shape: Dims) -> Dims:
        """Turn the shape of the own form's output into that of this dialect's."""
        return shape

    def shapes_to_own(self, shapes: Sequence[Dims | None]) -> Sequence[Dims | None]:
        """Turn the shapes of this dialect's inputs into those of the own form's."""
        return shapes

    def output_type(self, inputs: Values) -> ir.DataType | None:
        """Return the element type of this dialect's output: that of the first input."""
        return None if inputs[0] is None else inputs[0].dtype

    def in_types(
        self, call: FusedCall, inputs: Mapping[str, ir.Value | None]
    ) -> Values:
        """Cast integer operands, by name, to a type that this dialect takes."""
        cast = []
        for operand in self.operands:
            value = inputs.get(operand.name)
            if (
                value is not None
                and value.dtype in INTEGERS
                and value.dtype not in operand.types
            ):
                value = call.cast(value, operand.types[0])
            cast.append(value)
        while cast and cast[-1] is None:
            cast.pop()
        return tuple(cast)

    def attributes_of(self, node: ir.Node) -> dict[str, AttributeValue]:
        """Read a node's attributes, defaults filled in.

        Raises:
            PreconditionError: it has one that this dialect does not know, or a value
                that it does not take.
        """
        known = {each.name: each for each in self.attributes}
        found: dict[str, AttributeValue] = {
            each.name: each.default for each in self.attributes
        }
        for name, written in node.attributes.items():
            if name in PLUGIN_ATTRIBUTES:
                continue
            if name not in known:
                has = ", ".join(known) or "none"
                raise PreconditionError(
                    f"{self.call_of(node)}: no attribute {name!r}; there are {has}"
                )
            value = _value_of(written)
            kind, choices = type(known[name].default), known[name].choices
            if not isinstance(value, kind) or (choices and value not in choices):
                said = " or ".join(map(str, choices)) or kind.__name__
                raise PreconditionError(
                    f"{self.call_of(node)}: attribute {name} is {value!r}, not {said}"
                )
            found[name] = value
        return found

    def check(self, node: ir.Node) -> None:
        """Hold a node's inputs to this dialect, as far as shapes and types are known.

        Raises:
            PreconditionError: their number, types or shapes are of no such call.
        """
        least = sum(not each.optional for each in self.operands)
        count = len(node.inputs)
        if not least <= count <= len(self.operands):
            wanted = str(least) if least == len(self.operands) else f"{least} or more"
            raise PreconditionError(
                f"{self.call_of(node)} takes {wanted} inputs, found {count}"
            )
        sizes: dict[str, int] = {}
        for index, operand in enumerate(self.operands):
            value = input_at(node, index)
            if value is None:
                continue
            if not operand.takes(value.dtype):
                wanted = " or ".join(kind.name.lower() for kind in operand.types)
                kind = value.dtype.name.lower() if value.dtype is not None else "?"
                raise PreconditionError(
                    f"{self.call_of(node)}: {operand.name} is {kind}, not {wanted}"
                )
            self._check_shape(node, operand, open_shape(value), sizes)

    def call_of(self, node: ir.Node) -> str:
        """Name a node and what it calls, for messages."""
        name = node.name or node.outputs[0].name
        return f"node {name}: {self.op_type} of {self.source}"

    def _check_shape(
        self, node: ir.Node, operand: Operand, shape: Dims | None, sizes: dict[str, int]
    ) -> None:
        if operand.dims is None or shape is None:
            return
        wanted = operand.dims.split()
        fits = len(wanted) == len(shape)
        for letter, size in zip(wanted, shape, strict=False):
            if size is None or letter == "*":
                continue
            known = int(letter) if letter.isdigit() else sizes.setdefault(letter, size)
            fits = fits and known == size
        if not fits:
            spelt = {letter: f"{letter}={size}" for letter, size in sizes.items()}
            form = ", ".join(spelt.get(letter, letter) for letter in wanted)
            raise PreconditionError(
                f"{self.call_of(node)}: {operand.name} is"
                f" {[dim if dim is not None else '?' for dim in shape]}, not [{form}]"
            )


def present(inputs: Values) -> tuple[ir.Value, ...]:
    """Return the inputs of a call that are not left out."""
    return tuple(value for value in inputs if value is not None)


def number(attributes: Attributes, name: str) -> int:
    """Return an attribute that is one integer."""
    value = attributes[name]
    assert isinstance(value, int)
    return value


def numbers(attributes: Attributes, name: str) -> tuple[int, ...]:
    """Return an attribute that is a list of integers."""
    value = attributes[name]
    assert not isinstance(value, int | float | str)
    return tuple(value)


def _value_of(attribute: ir.Attr) -> AttributeValue:
    value = attribute.value
    if isinstance(value, list | tuple):
        return tuple(value)
    return value if isinstance(value, int | float | str) else str(value)
