"""Whatever half there is in a graph, convert-float32 tells what it changed."""

from collections import Counter

import onnx
import onnx_ir as ir
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.passes import Context
from me2e_compress.passes.convert_float16 import ConvertFloat16
from me2e_compress.passes.convert_float32 import ConvertFloat32
from me2e_compress.testing import check_pass
from tests.passes.small import apply, ops, read, types_of
from tests.support.nets import MODULES, conv_attention

HEAD = '<ir_version: 9, opset_import: ["" : 17, "own" : 1]>\n'
HALF, FLOAT = ir.DataType.FLOAT16, ir.DataType.FLOAT


@pytest.mark.parametrize(
    "text",
    [
        "g (float[2] x) => (float[2] y) <float[1] w = {1}> { d = Neg(x) y = Relu(x) }",
        "g (float[2] x) => (float[2] y) { y = Cast<to = 1>(x) }",
        "g (float16[2] x) => (float[2] y) { a = Cast<to = 1>(x) y = Relu(a) }",
        "g (float[2] x) => (float16[2] y) { a = Relu(x) y = Cast<to = 10>(a) }",
        "g (float16[2] x) => (float16[2] y) { y = Cast<to = 10>(x) }",
        """g (float[2] x) => (float[2] y) {
            a = Cast<to = 10>(x) b = own.Plugin(a) y = Cast<to = 1>(b)
        }""",
        """g (float[2] x, bool c) => (float16[2] y) {
            a = Cast<to = 10>(x)
            y = If (c) <then_branch = t () => (float16[2] t) { t = Neg(a) },
                        else_branch = e () => (float16[2] e) { e = Relu(a) }>
        }""",
    ],
    ids=["dead", "idle", "in", "out", "both", "plugin", "body"],
)
def test_where_nothing_is_to_be_done(text: str) -> None:
    assert apply(ConvertFloat32(), read(HEAD + text)).changes == 0


@pytest.mark.parametrize(
    ("x", "body", "left"),
    [
        ("int32", "a = Cast<to = 10>(x) y = Relu(a)", ["Relu"]),
        ("float16", "d = Neg(x) y = Relu(x)", ["Relu"]),
        ("float16", "a = Relu(x) y = Sigmoid(a)", ["Relu", "Sigmoid"]),
    ],
    ids=["a cast", "what is unread goes", "a half interface"],
)
def test_a_half_interface_is_cast(x: str, body: str, left: list[str]) -> None:
    text = f"g ({x}[2] x) => (float16[2] y) {{ {body} }}"

    model = apply(ConvertFloat32(), read(HEAD + text)).model

    casts = [each for each in model.graph if each.op_type == "Cast"]
    assert ops(model) == ["Cast", *left, "Cast"]
    assert [each.attributes.get_int("to") for each in casts] == [1, 10]
    assert set(types_of(model).values()) == {"FLOAT"}


@st.composite
def models(draw: st.DrawFn) -> ir.Model:
    """Draw nodes on halfs and floats, inputs with and without a default."""
    known = {"x": "float16", "f": "float", "d": "float16", "w": "float16"}
    lines = []
    for index in range(draw(st.integers(1, 7))):
        name = f"v{index}"
        one = draw(st.sampled_from(sorted(known)))
        two = draw(st.sampled_from([v for v in known if known[v] == known[one]]))
        if made := draw(st.sampled_from([None, None, "float", "float16", "int32"])):
            number = {"float": 1, "float16": 10, "int32": 6}[made]
            lines.append(f"{name} = Cast<to = {number}>({one})")
        elif known[one] == "int32":
            lines.append(f"{name} = Add({one}, {two})")
        else:
            operator = draw(
                st.sampled_from(
                    ["Relu({a})", "Add({a}, {b})", "own.Plugin({a})", "EyeLike({a})"]
                )
            )
            lines.append(f"{name} = {operator.format(a=one, b=two)}")
        known[name] = made or known[one]
    names = sorted(v for v in known if v.startswith("v"))
    outputs = draw(st.lists(st.sampled_from(names), min_size=1, unique=True))
    ports = ", ".join(f"{known[name]}[2,2] {name}" for name in outputs)
    four = "{1, 2, 3, 4}"
    return read(
        f"{HEAD}g (float16[2,2] x, float[2,2] f, float16[2,2] d = {four}) => ({ports})"
        f" <float16[2,2] w = {four}, float[2,2] idle = {four}> {{\n"
        + "\n".join(lines)
        + "\n}"
    )


@given(models())
def test_what_it_claims_it_did_and_only_once(model: ir.Model) -> None:
    result = apply(ConvertFloat32(), model)

    onnx.checker.check_model(ir.to_proto(result.model), full_check=True)


def test_back_to_float32() -> None:
    source = conv_attention()
    half = check_pass(ConvertFloat16(), source).model
    back = check_pass(ConvertFloat32(), half).model

    assert Counter(n.op_type for n in back.graph) == Counter(
        n.op_type for n in source.graph
    )
    assert {v.dtype for v in back.graph.initializers.values()} <= {
        FLOAT, ir.DataType.INT64
    }  # fmt: skip
    assert ConvertFloat32().run(back, Context(MODULES)).changes == 0
