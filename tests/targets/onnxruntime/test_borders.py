"""Which tensors become uint8, and who reads them as floats all the same."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.region import find_region
from tests.nets import net
from tests.targets.onnxruntime.lowered import block
from tests.targets.onnxruntime.test_sampled import aggregation


def test_a_sum_that_a_layer_reads_is_of_the_region() -> None:
    model = block()

    found = find_region(model.graph, {"z1", "z2", "z3", "y"})

    assert {str(value.name) for value in found.written} == {
        "a1", "p1", "a2", "z3", "a3", "y", "mean", "pooled",
    }  # fmt: skip
    assert {node.op_type for node in found.readers} == {
        "MaxPool", "Add", "GlobalAveragePool", "Flatten",
    }  # fmt: skip


def test_joined_maps_that_only_a_sampler_reads_are_of_the_region() -> None:
    model = aggregation()

    found = find_region(model.graph, {"c1", "c2", "y"})

    assert "maps" in {str(value.name) for value in found.written}
    assert "Concat" in {node.op_type for node in found.readers}


@pytest.mark.parametrize(
    ("outputs", "reader", "as_float"),
    [
        ("", "", False),
        (", float[1,4,8,8] p", "", True),
        (", float[1,4,8,8] z", "z = Sigmoid(p)", True),
        (", float[1,4,8,8] p, float[1,4,8,8] z", "z = Sigmoid(p)", True),
    ],
    ids=["a layer alone", "an output", "another operator", "both"],
)
def test_what_is_read_as_float(outputs: str, reader: str, as_float: bool) -> None:
    model = net(
        f"""<ir_version: 9, opset_import: ["" : 17]>
        c (float[1,4,8,8] x, float[4,4,1,1] w, float[4,4,1,1] v)
            => (float[1,4,8,8] y{outputs}) {{
            p = Conv(x, w) {reader} y = Conv(p, v)
        }}""",
        {"w": np.ones((4, 4, 1, 1)), "v": np.ones((4, 4, 1, 1))},
    )
    layers: list[ir.Node] = [n for n in model.graph if n.op_type == "Conv"]

    borders = OnnxRuntime().costs(model, layers).borders

    (between,) = (each for each in borders if each.makers == {layers[0]})
    assert between.readers == {layers[1]}
    assert between.read_as_float is as_float
