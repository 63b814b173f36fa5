import onnx_ir as ir
import pytest

from me2e_compress import graph

HEAD = '<ir_version: 9, opset_import: ["" : 17, "f" : 1, "trt" : 1]>\n'


def only_node(text: str) -> ir.Node:
    model = ir.from_onnx_text(HEAD + text)
    graph.infer_shapes(model)
    return model.graph[0]


@pytest.mark.parametrize(
    ("shapes", "call", "expected"),
    [
        ("2,3,8,8 4,3,3,3", "Conv(a, b)", 2 * 4 * 6 * 6 * 3 * 3 * 3),
        ("1,6,8,8 6,1,3,3", "Conv<group=6>(a, b)", 6 * 6 * 6 * 3 * 3),
        ("1,3,4,4 3,5,2,2", "ConvTranspose(a, b)", 3 * 4 * 4 * 5 * 2 * 2),
        ("1,4,5,5 4,3,2,2", "ConvTranspose<group=2>(a, b)", 4 * 5 * 5 * 3 * 2 * 2),
        ("7,4 4,5", "Gemm(a, b)", 7 * 4 * 5),
        ("4,7 5,4", "Gemm<transA=1, transB=1>(a, b)", 7 * 4 * 5),
        ("2,8,10,4 2,8,4,6", "MatMul(a, b)", 2 * 8 * 10 * 4 * 6),
        ("9 9", "MatMul(a, b)", 9),
        ("2,7,4 2,4,5", 'Einsum<equation="bij, bjk -> bik">(a, b)', 2 * 7 * 4 * 5),
        ("7,4", 'Einsum<equation="ij->ji">(a)', 0),
        ("7,2,3 3,4", 'Einsum<equation="...j,jk->...k">(a, b)', 7 * 2 * 3 * 4),
        (
            "30,2,4 2,32,4 2,32,8",
            'LSTM<hidden_size=8, direction="bidirectional">(a, b, c)',
            30 * 2 * 2 * (32 * 4 + 32 * 8),
        ),
        ("30,2,4 1,24,4 1,24,8", "GRU<hidden_size=8>(a, b, c)", 60 * (24 * 4 + 24 * 8)),
        ("30,2,4 1,8,4 1,8,8", "RNN<hidden_size=8>(a, b, c)", 60 * (8 * 4 + 8 * 8)),
        ("2,8,5,16 2,4,7,16 2,4,7,24", "Attention(a, b, c)", 2 * 8 * 5 * 7 * (16 + 24)),
        (
            "2,5,128 2,7,64 2,7,96",
            "Attention<q_num_heads=8, kv_num_heads=4>(a, b, c)",
            2 * 8 * 5 * 7 * (16 + 24),
        ),
        (
            "2,8,5,16 2,4,7,16 2,4,7,24 2,4,3,16 2,4,3,24",
            'Attention(a, b, c, "", d, e)',
            2 * 8 * 5 * (7 + 3) * (16 + 24),
        ),
        ("9", "Relu(a)", 0),
        # what is not known: an open shape, plugins, an operator that is not counted
        ("N,4 4,5", "MatMul(a, b)", None),
        ("1,2,4,4 1", "RotateTRT(a, b)", None),
        ("2", "trt.Rotate(a)", None),
        ("3,3", "Det(a)", None),
        ("2,3 3,4 4,2", 'Einsum<equation="ij,jk,kl->il">(a, b, c)', None),
    ],
)
def test_macs_by_hand(shapes: str, call: str, expected: int | None) -> None:
    sides = zip(shapes.split(), "abcde", strict=False)
    ports = ", ".join(f"float[{shape}] {name}" for shape, name in sides)
    outputs = "y, k, v" if '""' in call else "y"
    text = f"m ({ports}) => (y) {{ {outputs} = {call} }}"
    assert graph.macs(only_node(text)) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "m (uint8[1,3,8,8] x, float s, uint8 z, int8[4,3,3,3] w)"
            " => (uint8[1,4,6,6] y) { y = QLinearConv(x, s, z, w, s, z, s, z) }",
            4 * 6 * 6 * 3 * 3 * 3,
        ),
        (
            "m (float[1,6,8,8] x, float[4,6,3,3] w, float[1,18,6,6] o)"
            " => (float[1,4,6,6] y) { y = DeformConv(x, w, o) }",
            4 * 6 * 6 * 6 * 3 * 3,
        ),
        (
            "m (int64 n, bool c, float[2,2] x) => (float[2,2] y) {"
            " y = Loop (n, c, x) <body = b (int64 i, bool d, float[2,2] a)"
            " => (bool d, float[2,2] e) { e = MatMul(a, a) }> }",
            None,
        ),
    ],
)
def test_macs_of_operators_with_other_inputs(text: str, expected: int | None) -> None:
    assert graph.macs(only_node(text)) == expected


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
