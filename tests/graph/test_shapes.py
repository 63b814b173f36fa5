"""What is known of shapes, and what an exporter's symbols must not hide."""

import pytest

from me2e_compress import graph
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from tests.support.nets import parsed

CHAIN = """
six (float[BATCH,6,8] x) => (float["Addy_dim_0","Addy_dim_1",8] y, float[one,48] z)
    <int64[1] minus = {-1}, int64 zero = {0}>
{
    y = Add(x, x)
    s = Shape(y)
    b = Gather(s, zero)
    r = Reshape(b, minus)
    full = Concat<axis=0>(r, minus)
    z = Reshape(y, full)
}
"""


@pytest.mark.parametrize(
    ("batch", "shape"), [("1", "[1,6,8]"), ("batch", "[Addy_dim_0,6,8]")]
)
def test_an_output_s_symbol_stays_where_the_size_is_open(
    batch: str, shape: str
) -> None:
    model = parsed(CHAIN.replace("BATCH", batch))
    graph.infer_shapes(model)
    assert str(model.graph.outputs[0].shape) == shape


def test_shape_arithmetic_behind_an_output_with_a_symbol_is_folded() -> None:
    model = parsed(CHAIN.replace("BATCH", "1"))
    report = PassManager(recipe.load("exact")).run(model, Context(ModuleMap.whole()))
    assert [node.op_type for node in report.model.graph] == ["Add", "Reshape"]
    shapes = [str(value.shape) for value in report.model.graph.outputs]
    assert shapes == ["[1,6,8]", "[1,48]"]
