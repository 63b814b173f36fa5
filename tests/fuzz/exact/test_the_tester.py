"""The tester can fail: passes that are wrong on purpose are caught, and shrunk."""

import dataclasses
import subprocess
import sys
from typing import ClassVar

import onnx
import onnx.parser
import onnx_ir as ir
import pytest

from me2e_compress.graph import provenance
from me2e_compress.passes import Context, Pass, PassResult
from tests.fuzz.exact.judging import Case, Kind, shrunk
from tests.fuzz.exact.running import RefusedError

TEXT = """
<ir_version: 8, opset_import: ["" : 17]>
g (float[4,6] x, float[4,6] y, float[6] unread) => (float[4,6] z, float[6] w)
<int64[1] axis = {0}> {
    a = Add(x, y)  b = Relu(a)  d = Mul(b, y)  e = Softmax(d)  f = Tanh(e)
    h = Neg(f)  i = Add(h, x)
    k = Abs(i)  z = Sqrt(k)  l = Sigmoid(y)  w = ReduceSum<keepdims = 0>(l, axis)
}
"""


@dataclasses.dataclass(frozen=True)
class Faulty(Pass):
    """Do to every Tanh what no exact pass may.

    Attributes:
        how: ``wrong`` takes a Sigmoid, ``crash`` raises, ``nowhere`` takes an operator
            that there is not, ``again`` swaps what the Adds read on every run.
    """

    name: ClassVar[str] = "faulty"
    exact: ClassVar[bool] = True
    how: str = "wrong"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        kind = "Add" if self.how == "again" else "Tanh"
        found = [node for node in model.graph if node.op_type == kind]
        for node in found:
            if self.how == "crash":
                raise KeyError(node.name)
            if self.how == "again":
                one, other = node.inputs
                node.replace_input_with(0, other)
                node.replace_input_with(1, one)
            else:
                node.op_type = "Sigmoid" if self.how == "wrong" else "NoSuchOperator"
            provenance.inherit(node, [node], by=self.name)
        return PassResult(model, len(found))


def kind_of(model: onnx.ModelProto, how: str) -> Kind:
    try:
        return Case(model).judge_passes([Faulty(how)], how).kind
    except RefusedError:
        return "invalid-draw"


@pytest.mark.parametrize(
    ("how", "kind"),
    [
        ("wrong", "wrong"),
        ("crash", "crash"),
        ("nowhere", "does-not-load"),
        ("again", "changes-again"),
    ],
)
def test_a_pass_that_is_wrong_is_caught_and_shrunk(how: str, kind: Kind) -> None:
    model = onnx.parser.parse_model(TEXT)
    assert kind_of(model, how) == kind
    small = onnx.parser.parse_model(shrunk(model, lambda part: kind_of(part, how)))
    assert len(small.graph.node) <= 2
    assert kind_of(small, how) == kind


@pytest.mark.slow
def test_a_night_starts_its_workers() -> None:
    command = [sys.executable, "-m", "tests.fuzz.exact", "--graphs", "2", "--jobs", "1"]
    subprocess.run(command, check=True)
