import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import VerificationError
from me2e_compress.graph.shapes import Dims
from me2e_compress.operators import (
    OPERATORS,
    Attribute,
    Dialect,
    FusedCall,
    Operand,
    Operator,
)
from me2e_compress.operators.call import Attributes
from me2e_compress.operators.dialect import Arrays, NdArray, Values, number, present
from me2e_compress.testing import DrawnCall, check_operator


def matrices(dialect: Dialect, random: np.random.Generator) -> DrawnCall:
    matrix = random.normal(size=(2, 3, 4, 4)) + 4 * np.eye(4)
    return DrawnCall({"matrix": matrix.astype(np.float32)})


def _plugin(name: str, op_type: str, domain: str) -> Dialect:
    gain = (Attribute("gain", 2),)
    return Dialect(name, op_type, domain, (Operand("x"),), "test", gain)


@dataclasses.dataclass(frozen=True)
class Gain(Operator):
    """Multiply by a whole number; those below err in one way."""

    name: ClassVar[str] = "gain"
    own: ClassVar[Dialect] = _plugin("me2e", "Gain", "me2e")
    dialects: ClassVar[tuple[Dialect, ...]] = (_plugin("test", "GainPlugin", "some"),)

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        (x,) = present(inputs)
        return call.add("Mul", [x, call.numbers(number(attributes, "gain"), x)])

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        result: NdArray = np.asarray(inputs[0], np.float64) * number(attributes, "gain")
        return result

    def output_shape(
        self, shapes: Sequence[Dims | None], attributes: Attributes
    ) -> Dims | None:
        return shapes[0]

    def macs(self, shapes: Sequence[Dims | None], attributes: Attributes) -> int | None:
        return None


def test_what_is_right_holds() -> None:
    for name in ("select-and-pad", "multi-head-attention"):
        check_operator(OPERATORS.build(name, {}), calls=2)
    check_operator(OPERATORS.build("inverse", {}), matrices, calls=1)
    check_operator(Gain(), calls=1)  # which is not installed


@dataclasses.dataclass(frozen=True)
class OtherBody(Gain):
    """A body that adds."""

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        (x,) = present(inputs)
        return call.add("Add", [x, call.numbers(2, x)])


@dataclasses.dataclass(frozen=True)
class FlatBody(Gain):
    """A body that loses the shape."""

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        return call.reshape(super().body(call, inputs, attributes), (1, 1, 1, 1, -1))


@dataclasses.dataclass(frozen=True)
class OtherShape(Gain):
    """A shape that is too long."""

    def output_shape(
        self, shapes: Sequence[Dims | None], attributes: Attributes
    ) -> Dims | None:
        return None if shapes[0] is None else (*shapes[0], 1)


@dataclasses.dataclass(frozen=True)
class OtherLetters(Gain):
    """Work in a letter that no operand has."""

    work: ClassVar[str] = "2 gain Q"


@dataclasses.dataclass(frozen=True)
class LateBody(Gain):
    """A body that errs from opset 18 on."""

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        found = super().body(call, inputs, attributes)
        return found if call.opset < 18 else call.add("Neg", [found])


class Forgetful(Dialect):
    """Translates into a call without the attribute."""

    def options_from_own(self, attributes: Attributes) -> Attributes:
        return {"gain": 3}


class Counted(Dialect):
    """Says that it gives integers."""

    def output_type(self, inputs: Values) -> ir.DataType | None:
        return ir.DataType.INT32


def spelt(kind: type[Dialect]) -> Operator:
    """Return the operator whose dialect is of that kind."""

    @dataclasses.dataclass(frozen=True)
    class Spelt(Gain):
        """Errs in its dialect."""

        dialects: ClassVar[tuple[Dialect, ...]] = (kind(**vars(Gain.dialects[0])),)

    return Spelt()


@dataclasses.dataclass(frozen=True)
class OtherOwn(Gain):
    """No own form."""

    own: ClassVar[Dialect] = Gain.dialects[0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (OtherBody(), "gain in the dialect me2e, opset 13: the body is off"),
        (FlatBody(), r"me2e, opset 13: the body gives \[1, 1, 1, 1, \d+\]"),
        (OtherShape(), "me2e, opset 13: the output is said to be"),
        (spelt(Forgetful), "test, opset 13: a translated call is off"),
        (
            spelt(Counted),
            "test, opset 13: the output is said to be INT32, it is float32",
        ),
        (OtherLetters(), "gain: work has 'Q', which is no letter of an operand"),
        (LateBody(), "gain in the dialect me2e, opset 20: the body is off"),
        (OtherOwn(), "gain: the own form is 'test' in the domain 'some'"),
    ],
    ids=lambda each: type(each).__name__,
)
def test_what_is_wrong_is_named(wrong: Operator, message: str) -> None:
    with pytest.raises(VerificationError, match=message):
        check_operator(wrong, calls=1)
