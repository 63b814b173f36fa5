import onnx_ir as ir
import pytest

from me2e_compress import graph

HEAD = '<ir_version: 9, opset_import: ["" : 17, "f" : 1]>\n'


def only_node(text: str) -> ir.Node:
    model = ir.from_onnx_text(HEAD + text)
    graph.infer_shapes(model)
    return model.graph[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "m (float[2,3,8,8] x, float[4,3,3,3] w) => (float[2,4,6,6] y)"
            " { y = Conv(x, w) }",
            2 * 4 * 6 * 6 * 3 * 3 * 3,
        ),
        (
            "m (float[1,6,8,8] x, float[6,1,3,3] w) => (float[1,6,6,6] y)"
            " { y = Conv<group=6>(x, w) }",
            6 * 6 * 6 * 3 * 3,
        ),
        (
            "m (float[1,3,4,4] x, float[3,5,2,2] w) => (float[1,5,5,5] y)"
            " { y = ConvTranspose(x, w) }",
            3 * 4 * 4 * 5 * 2 * 2,
        ),
        (
            "m (float[7,4] x, float[4,5] w) => (float[7,5] y) { y = Gemm(x, w) }",
            7 * 4 * 5,
        ),
        (
            "m (float[4,7] x, float[5,4] w) => (float[7,5] y)"
            " { y = Gemm<transA=1, transB=1>(x, w) }",
            7 * 4 * 5,
        ),
        (
            "m (float[2,8,10,4] x, float[2,8,4,6] w) => (float[2,8,10,6] y)"
            " { y = MatMul(x, w) }",
            2 * 8 * 10 * 4 * 6,
        ),
        ("m (float[9] x, float[9] w) => (float y) { y = MatMul(x, w) }", 9),
        ("m (float[9] x) => (float[9] y) { y = Relu(x) }", 0),
    ],
)
def test_macs_by_hand(text: str, expected: int) -> None:
    assert graph.macs(only_node(text)) == expected


def test_macs_of_an_open_shape_are_not_known() -> None:
    text = "m (float[N,4] x, float[4,5] w) => (float[N,5] y) { y = MatMul(x, w) }"
    assert graph.macs(only_node(text)) is None


def test_a_function_counts_at_every_call() -> None:
    model = ir.from_onnx_text(
        HEAD + "m (float[2] x) => (float[2] y) { a = f.twice(x)\n y = f.twice(a) }\n"
        '<domain: "f", opset_import: ["" : 17]> twice (x) => (y)'
        " { a = Relu(x)\n y = Relu(a) }"
    )
    assert graph.node_count(model) == 4


def test_nodes_in_branches_count() -> None:
    model = ir.from_onnx_text(
        HEAD + "m (bool c, float[2] x) => (float[2] y) {"
        " y = If(c) <then_branch = t () => (float[2] a) { a = Relu(x) },"
        " else_branch = e () => (float[2] b) { b = Neg(x) }> }"
    )
    assert graph.node_count(model) == 3
