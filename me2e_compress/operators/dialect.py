"""Dialects of fused operators: how a plugin library spells them."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph.nodes import input_at
from me2e_compress.graph.shapes import Dims, open_shape
from me2e_compress.operators.call import Attributes, AttributeValue, FusedCall

# The domain of the toolkit's own form of every fused operator, opset 1
OWN_DOMAIN = "me2e"

NdArray: TypeAlias = npt.NDArray[Any]
Arrays: TypeAlias = Sequence[NdArray | None]
Values: TypeAlias = Sequence[ir.Value | None]
Shapes: TypeAlias = Sequence[Dims | None]

FLOATS = (ir.DataType.FLOAT, ir.DataType.FLOAT16)
FLOAT32 = (ir.DataType.FLOAT,)
INT8_TOO = (*FLOATS, ir.DataType.INT8)
INT32 = (ir.DataType.INT32,)
INTEGERS = (ir.DataType.INT32, ir.DataType.INT64)

# Attributes by which TensorRT finds a plugin, besides the operator's name
PLUGIN_ATTRIBUTES = ("plugin_version", "plugin_namespace")


@dataclasses.dataclass(frozen=True)
class Operand:
    """One input of a fused operator.

    ``dims`` are its dimensions, separated by blanks: a number, a letter for a size that
    is equal in all operands of a call, or ``*`` for any; None for any rank.
    """

    name: str  # in messages
    dims: str | None = None
    types: tuple[ir.DataType, ...] = FLOATS
    optional: bool = False  # it, and all inputs after it, may be omitted
    positions: bool = False  # of samples, or matrices to invert: these stay in float
    scores: bool = False  # weights before their softmax

    @property
    def letters(self) -> list[str]:
        """Its dimensions one by one; none where any number is accepted."""
        return [] if self.dims is None else self.dims.split()

    @property
    def rank(self) -> int | None:
        """The number of dimensions; None where any number is accepted."""
        return None if self.dims is None else len(self.letters)

    def takes(self, kind: ir.DataType | None) -> bool:
        """Return whether an element type is accepted, float64 counting as float32."""
        if kind == ir.DataType.DOUBLE:
            kind = ir.DataType.FLOAT
        return kind is None or kind in self.types


@dataclasses.dataclass(frozen=True)
class Attribute:
    """One attribute of a fused operator.

    ``own`` is its name in the own form: None where that is the same, empty where the
    own form lacks it.
    """

    name: str
    default: int | float | str | tuple[int, ...]  # what a conversion writes otherwise
    required: bool = True  # the plugin refuses a node without it
    choices: tuple[int | str, ...] = ()  # the allowed values; empty for any
    own: str | None = None

    @property
    def own_name(self) -> str:
        """Its name in the own form; empty if that lacks it."""
        return self.name if self.own is None else self.own


@dataclasses.dataclass(frozen=True)
class Dialect:
    """How one library spells an operator; this base class has the own form's inputs.

    Subclasses override the conversions where inputs, attributes or output differ:
    ``inputs_*`` and ``result_*`` write them as nodes, ``options_*`` convert attributes,
    and ``shape*`` shapes. ``int8_scale`` is the index of the input with the scales of
    int8 features, float32, one per channel; None if there is none.
    """

    name: str  # for `translate-plugins` and `--dialect`
    op_type: str  # the operator's name in a file
    domain: str  # that exporters use
    operands: tuple[Operand, ...]
    source: str = ""  # the library, for messages
    attributes: tuple[Attribute, ...] = ()  # but those of PLUGIN_ATTRIBUTES
    version: str = "1"  # the `plugin_version` that TensorRT looks for
    namespace: str = ""  # the `plugin_namespace` that TensorRT looks for
    int8_scale: int | None = None

    def inputs_to_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write the conversion of this dialect's inputs to the own form's."""
        return inputs

    def inputs_from_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write the conversion of the own form's inputs to this dialect's."""
        return self.in_types(call, inputs)

    def by_kernel(self, call: FusedCall, inputs: Values) -> ir.Value | None:
        """Call a compiled kernel that takes these inputs; None if there is none."""
        return None

    def options_to_own(self, attributes: Attributes) -> Attributes:
        """Convert this dialect's attributes to the own form's."""
        known = [a for a in self.attributes if a.name in attributes and a.own_name]
        return {a.own_name: attributes[a.name] for a in known}

    def options_from_own(self, attributes: Attributes) -> Attributes:
        """Convert the own form's attributes to this dialect's."""
        return {a.name: attributes.get(a.own_name, a.default) for a in self.attributes}

    def result_to_own(self, call: FusedCall, result: ir.Value, own: Values) -> ir.Value:
        """Write the conversion of this dialect's output to the own form's."""
        return result

    def result_from_own(
        self, call: FusedCall, result: ir.Value, own: Values
    ) -> ir.Value:
        """Write the conversion of the own form's output to this dialect's."""
        return result

    def shape_from_own(self, shape: Dims) -> Dims:
        """Convert the shape of the own form's output to that of this dialect's."""
        return shape

    def shapes_to_own(self, shapes: Shapes) -> Shapes:
        """Convert the shapes of this dialect's inputs to those of the own form's."""
        return shapes

    def output_type(self, inputs: Values) -> ir.DataType | None:
        """Return the element type of this dialect's output: that of the first input."""
        return None if inputs[0] is None else inputs[0].dtype

    def in_types(self, call: FusedCall, inputs: Values) -> Values:
        """Cast integer operands to a type that this dialect accepts."""
        cast = list(inputs[: len(self.operands)])
        while cast and cast[-1] is None:
            cast.pop()
        for index, value in enumerate(cast):
            types = self.operands[index].types
            if value is not None and value.dtype in {*INTEGERS} - {*types}:
                cast[index] = call.cast(value, types[0])
        return tuple(cast)

    def attributes_of(self, node: ir.Node) -> dict[str, AttributeValue]:
        """Return a node's attributes, completed by defaults.

        Raises:
            PreconditionError: an attribute is unknown, or has a value it cannot have.
        """
        known = {known.name: known for known in self.attributes}
        attributes: dict[str, AttributeValue] = {n: a.default for n, a in known.items()}
        # Both name and value must be allowed
        for name, attribute in node.attributes.items():
            if name in PLUGIN_ATTRIBUTES:
                continue
            if name not in known:
                has = ", ".join(known) or "none"
                raise PreconditionError(
                    f"{self.call_of(node)}: no attribute {name!r}; there are {has}"
                )
            value = attribute.value
            if isinstance(value, list | tuple):
                value = tuple(value)
            elif not isinstance(value, int | float | str):
                value = str(value)
            kind, choices = type(known[name].default), known[name].choices
            if not isinstance(value, kind) or (choices and value not in choices):
                among = " or ".join(map(str, choices)) or kind.__name__
                raise PreconditionError(
                    f"{self.call_of(node)}: attribute {name} is {value!r}, not {among}"
                )
            attributes[name] = value
        return attributes

    def check(self, node: ir.Node) -> None:
        """Raise a PreconditionError where the inputs of a node do not fit."""
        # The number of inputs
        least = sum(not operand.optional for operand in self.operands)
        count = len(node.inputs)
        if not least <= count <= len(self.operands):
            wanted = str(least) if least == len(self.operands) else f"{least} or more"
            raise PreconditionError(
                f"{self.call_of(node)} takes {wanted} inputs, found {count}"
            )
        # Types, then dimensions: a letter has one size in all operands
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
            letters, shape = operand.letters, open_shape(value)
            if operand.dims is None or shape is None:
                continue
            fits = len(letters) == len(shape)
            for letter, size in zip(letters, shape, strict=False):
                if size is None or letter == "*":
                    continue
                is_number = letter.isdigit()
                known = int(letter) if is_number else sizes.setdefault(letter, size)
                fits = fits and known == size
            if not fits:
                # Show the sizes known so far
                spelt = {letter: f"{letter}={size}" for letter, size in sizes.items()}
                form = ", ".join(spelt.get(letter, letter) for letter in letters)
                dims = ", ".join("'?'" if d is None else str(d) for d in shape)
                raise PreconditionError(
                    f"{self.call_of(node)}: {operand.name} is [{dims}], not [{form}]"
                )

    def call_of(self, node: ir.Node) -> str:
        """Name a node and its operator, for messages."""
        name = node.name or node.outputs[0].name
        return f"node {name}: {self.op_type} of {self.source}"


def present(inputs: Values) -> tuple[ir.Value, ...]:
    """Return the inputs of a call that are not omitted."""
    return tuple(value for value in inputs if value is not None)


def number(attributes: Attributes, name: str) -> int:
    """Return an integer attribute."""
    value = attributes[name]
    assert isinstance(value, int)
    return value


def numbers(attributes: Attributes, name: str) -> tuple[int, ...]:
    """Return an attribute that is a list of integers."""
    value = attributes[name]
    assert not isinstance(value, int | float | str)
    return tuple(value)
