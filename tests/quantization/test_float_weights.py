import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.workflows.int8_outcome import FloatWeight, float_weights
from tests.nets import MODULES, net

TEXT = """
net (float[1,32,32] x, int64[4] ids, float[32,64] layer, float[64,64] table,
     float[1,256,64] recurrent, float[1,256,64] step, float[8] small)
    => (float[1,32,64] y, float[4,64] rows, float[32,1,1,64] state) {
    ["/backbone/MatMul"] y = MatMul(x, layer)
    ["/head/Gather"] rows = Gather(table, ids)
    ["/head/Transpose"] t = Transpose<perm=[1,0,2]>(y)
    ["/head/LSTM"] state = LSTM<hidden_size=64>(t, recurrent, step)
    ["/head/Add"] unused = Add(small, small)
}
"""


@pytest.fixture(scope="module")
def model() -> ir.Model:
    shapes = {
        "layer": (32, 64),
        "table": (64, 64),
        "recurrent": (1, 256, 64),
        "step": (1, 256, 64),
        "small": (8,),
    }
    return net(TEXT, {name: np.ones(shape) for name, shape in shapes.items()})


def left(model: ir.Model, modules: tuple[str, ...]) -> tuple[FloatWeight, ...]:
    quantizer = QuantizeInt8(modules=modules, rules="paper")
    return float_weights(model, quantizer.plan(model, Context(MODULES)))


def test_the_largest_weights_that_stay_float_come_first(model: ir.Model) -> None:
    found = left(model, ("backbone", "head"))

    assert [each.name for each in found] == ["recurrent", "step", "table"]
    assert found[0].bytes == 4 * 256 * 64
    assert (found[0].op, found[0].module, found[0].rule) == ("LSTM", "head", "operator")
    assert found[0].reason == "LSTM is not a weighted layer"


def test_a_layer_outside_the_scheme_is_named_with_its_rule(model: ir.Model) -> None:
    (layer,) = [each for each in left(model, ("head",)) if each.name == "layer"]

    assert layer.rule == "module"
    assert layer.node == "/backbone/MatMul"
