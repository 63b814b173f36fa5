import onnx_ir as ir
import pytest

from me2e_compress import graph

HEAD = '<ir_version: 9, opset_import: ["" : 17, "f" : 1, "trt" : 1]>\n'


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
        (
            "m (float[2,7,4] x, float[2,4,5] w) => (float[2,7,5] y)"
            ' { y = Einsum<equation="bij, bjk -> bik">(x, w) }',
            2 * 7 * 4 * 5,
        ),
        ('m (float[7,4] x) => (float[4,7] y) { y = Einsum<equation="ij->ji">(x) }', 0),
        (
            "m (uint8[1,3,8,8] x, float s, uint8 z, int8[4,3,3,3] w)"
            " => (uint8[1,4,6,6] y) { y = QLinearConv(x, s, z, w, s, z, s, z) }",
            4 * 6 * 6 * 3 * 3 * 3,
        ),
        (
            "m (float[30,2,4] x, float[2,32,4] w, float[2,32,8] r)"
            " => (float[30,2,2,8] y) { y = LSTM<hidden_size=8,"
            ' direction="bidirectional">(x, w, r) }',
            30 * 2 * 2 * (32 * 4 + 32 * 8),
        ),
        (
            "m (float[30,2,4] x, float[1,24,4] w, float[1,24,8] r)"
            " => (float[30,1,2,8] y) { y = GRU<hidden_size=8>(x, w, r) }",
            30 * 2 * (24 * 4 + 24 * 8),
        ),
        (
            "m (float[30,2,4] x, float[1,8,4] w, float[1,8,8] r)"
            " => (float[30,1,2,8] y) { y = RNN<hidden_size=8>(x, w, r) }",
            30 * 2 * (8 * 4 + 8 * 8),
        ),
        (
            "m (float[1,6,8,8] x, float[4,6,3,3] w, float[1,18,6,6] o)"
            " => (float[1,4,6,6] y) { y = DeformConv(x, w, o) }",
            4 * 6 * 6 * 6 * 3 * 3,
        ),
        (
            "m (float[1,4,5,5] x, float[4,3,2,2] w) => (float[1,6,6,6] y)"
            " { y = ConvTranspose<group=2>(x, w) }",
            4 * 5 * 5 * 3 * 2 * 2,
        ),
        (
            "m (float[7,2,3] x, float[3,4] w) => (float[7,2,4] y)"
            ' { y = Einsum<equation="...j,jk->...k">(x, w) }',
            7 * 2 * 3 * 4,
        ),
        (
            "m (float[2,8,5,16] q, float[2,4,7,16] k, float[2,4,7,24] v)"
            " => (float[2,8,5,24] y) { y = Attention(q, k, v) }",
            2 * 8 * 5 * 7 * (16 + 24),
        ),
        (
            "m (float[2,5,128] q, float[2,7,64] k, float[2,7,96] v)"
            " => (float[2,5,192] y)"
            " { y = Attention<q_num_heads=8, kv_num_heads=4>(q, k, v) }",
            2 * 8 * 5 * 7 * (16 + 24),
        ),
        (
            "m (float[2,8,5,16] q, float[2,4,7,16] k, float[2,4,7,24] v,"
            " float[2,4,3,16] a, float[2,4,3,24] b) => (float[2,8,5,24] y)"
            ' { y, m, n = Attention(q, k, v, "", a, b) }',
            2 * 8 * 5 * (7 + 3) * (16 + 24),
        ),
        ("m (float[9] x) => (float[9] y) { y = Relu(x) }", 0),
    ],
)
def test_macs_by_hand(text: str, expected: int) -> None:
    assert graph.macs(only_node(text)) == expected


@pytest.mark.parametrize(
    "text",
    [
        "m (float[N,4] x, float[4,5] w) => (float[N,5] y) { y = MatMul(x, w) }",
        "m (float[1,2,4,4] x, float t) => (float[1,2,4,4] y) { y = RotateTRT(x, t) }",
        "m (float[2] x) => (float[2] y) { y = trt.Rotate(x) }",
        "m (float[3,3] x) => (float y) { y = Det(x) }",
        "m (float[2,3] x, float[3,4] w, float[4,2] v) => (float[2,2] y)"
        ' { y = Einsum<equation="ij,jk,kl->il">(x, w, v) }',
        "m (int64 n, bool c, float[2,2] x) => (float[2,2] y) {"
        " y = Loop (n, c, x) <body = b (int64 i, bool d, float[2,2] a)"
        " => (bool d, float[2,2] e) { e = MatMul(a, a) }> }",
    ],
    ids=["open shape", "plugin", "domain", "uncounted", "three", "loop"],
)
def test_macs_that_are_not_known(text: str) -> None:
    assert graph.macs(only_node(text)) is None


FUNCTION = """m (float[2,2] x) => (float[2,2] y) { y = f.local(x) }
<domain: "f", opset_import: ["" : 17]> local (x) => (y) { BODY }"""


@pytest.mark.parametrize(
    ("text", "macs", "unknown"),
    [
        (
            "m (float[2,3] x, float[3,4] w) => (float[2,4] y)"
            " { a = MatMul(x, w)\n y = trt.Rotate(a) }",
            *(2 * 3 * 4, 1),
        ),
        ("m (float[2] x) => (float[2] y) { y = trt.Rotate(x) }", None, 1),
        (FUNCTION.replace("BODY", "y = Relu(x)"), 0, 0),
        (FUNCTION.replace("BODY", "y = MatMul(x, x)"), None, 1),
    ],
    ids=["a lower bound", "nothing known is not zero", "a function", "its product"],
)
def test_the_sum_of_a_graph(text: str, macs: int | None, unknown: int) -> None:
    model = ir.from_onnx_text(HEAD + text)
    graph.infer_shapes(model)
    size = graph.size(model)
    assert (size.macs, size.unknown_macs_nodes) == (macs, unknown)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        (
            "m (float[2] x) => (float[2] y) { a = f.twice(x)\n y = f.twice(a) }\n"
            '<domain: "f", opset_import: ["" : 17]> twice (x) => (y)'
            " { a = Relu(x)\n y = Relu(a) }",
            4,  # a function counts at every call
        ),
        (
            "m (bool c, float[2] x) => (float[2] y) {"
            " y = If(c) <then_branch = t () => (float[2] a) { a = Relu(x) },"
            " else_branch = e () => (float[2] b) { b = Neg(x) }> }",
            3,
        ),
    ],
)
def test_nodes_in_functions_and_branches_count(text: str, count: int) -> None:
    assert graph.node_count(ir.from_onnx_text(HEAD + text)) == count
