"""Large graphs: calls grow with the nodes, and nothing is too long to look at."""

import onnx_ir as ir

from me2e_compress.graph import infer_shapes
from me2e_compress.passes.hoist_linear import HoistLinear
from tests.calls import calls
from tests.passes.hoisted import graph_of, integers, normal
from tests.passes.small import NO_MODULES, read


def copies(count: int) -> ir.Model:
    """Many products of repeated rows, each an output of the graph."""
    body = "".join(
        f"t{at} = Expand(x{at}, shape)  y{at} = MatMul(t{at}, w)  "
        for at in range(count)
    )
    inputs = ", ".join(f"float[1,4,16] x{at}" for at in range(count))
    outputs = ", ".join(f"float[64,4,16] y{at}" for at in range(count))
    text = graph_of(f"({inputs}) => ({outputs})", body)
    model = read(text, w=normal(16, 16), shape=integers(64, 4, 16))
    infer_shapes(model)
    return model


def test_the_work_is_linear_in_the_rewrites_even_of_outputs() -> None:
    few, many = copies(20), copies(80)

    least = calls(lambda: HoistLinear().run(few, NO_MODULES))
    most = calls(lambda: HoistLinear().run(many, NO_MODULES))

    assert most < 5 * least


def test_a_sum_of_thousands_of_terms_in_front_of_a_product() -> None:
    terms = 1200
    added = "".join(f"z{at} = Add(z{at - 1}, x)  " for at in range(1, terms))
    body = f"z0 = Relu(x)  {added} y = MatMul(z{terms - 1}, w)"
    model = read(graph_of("(float[4,16] x) => (float[4,16] y)", body), w=normal(16, 16))
    infer_shapes(model)

    assert HoistLinear().run(model, NO_MODULES).changes == 0
