"""Attention becomes one node with a kernel, in every layout; near misses stay."""

import re
from unittest.mock import Mock

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.operators import find
from me2e_compress.passes.fuse_kernels import FuseKernels, attention
from me2e_compress.runtime import runnable
from me2e_compress.runtime.session import Session
from tests.passes.small import apply, compute, fed, ops, read
from tests.support.profiles import scaled

Q, K, H, C = 9, 70, 2, 16
HEAD = '<ir_version: 9, opset_import: ["" : 17]>'
AHEAD = [0, 2, 1, 3]
LAYOUTS: dict[str, tuple[str, str, str, str, tuple[list[int] | None, ...]]] = {
    "heads in the batch": (
        *(f"1,{H},{Q},{C}", f"1,{H},{K},{C}", f"1,{H},{K},{C}", f"1,{H},{Q},{C}"),
        (None, [0, 1, 3, 2], None, None),
    ),
    "keys that are turned": (
        *(f"{H},{Q},{C}", f"{H},{C},{K}", f"{H},{K},{C}", f"{H},{Q},{C}"),
        (None, None, None, None),
    ),
    "side by side": (
        *(f"2,{Q},{H},{C}", f"2,{K},{H},{C}", f"2,{K},{H},{C}", f"2,{Q},{H},{C}"),
        (AHEAD, [0, 2, 3, 1], AHEAD, AHEAD),
    ),
    "side by side, of rank 3": (
        *(f"{Q},{H},{C}", f"{K},{H},{C}", f"{K},{H},{C}", f"{Q},{H},{C}"),
        ([1, 0, 2], [1, 2, 0], [1, 0, 2], [1, 0, 2]),
    ),
    "one of them otherwise": (
        *(f"2,{H},{C},{Q}", f"2,{K},{H},{C}", f"2,{K},{H},{C}", f"2,{Q},{H},{C}"),
        ([0, 1, 3, 2], [0, 2, 3, 1], AHEAD, AHEAD),
    ),
}
"""The shapes of q, k, v and y, and how each is turned."""


def turned(layout: str) -> str:
    q, k, v, y, perms = LAYOUTS[layout]
    names = zip(("qt", "kt", "vt", "y"), "qkvz", perms, strict=True)
    *before, behind = (
        f"{made} = {f'Transpose<perm={perm}>' if perm else 'Identity'}({given})"
        for made, given, perm in names
    )
    return (
        f"m (float[{q}] q, float[{k}] k, float[{v}] v) => (float[{y}] y)"
        f" <float s = {{SCALE}}, float t = {{TIMES}}> {{"
        f" {' '.join(before)} BODY {behind} }}"
    )


SCALED = {
    "query": "a = Mul(qt, s) b = MatMul(a, kt) w = Softmax<axis=-1>(b)",
    "key": "a = Mul(s, kt) b = MatMul(qt, a) w = Softmax(b)",
    "product": "a = MatMul(qt, kt) b = Div(a, t) w = Softmax(b)",
    "both": "a = Div(qt, t) c = Mul(kt, t) d = MatMul(a, c) b = Mul(d, s) "
    "w = Softmax(b)",
    "none": "b = MatMul(qt, kt) w = Softmax(b)",
}


@pytest.fixture(autouse=True)
def open_gate(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "gate" not in request.node.name:
        monkeypatch.setattr(attention, "pays", Mock(return_value=True))


@pytest.mark.parametrize(
    ("layout", "sizes", "is_fused"),
    [
        ("side by side", (9, 70, 2, 16), True),
        ("heads in the batch", (9, 70, 2, 16), False),  # most of a vector is empty
        ("heads in the batch", (48, 70, 2, 16), True),
        ("side by side", (150, 64, 2, 128), False),  # wide heads, few keys
        ("side by side", (150, 256, 2, 128), True),
        ("heads in the batch", (300, 256, 2, 16), False),
        ("heads in the batch", (512, 512, 2, 16), True),  # scores leave the cache
    ],
)
def test_the_gate_knows_sizes(
    layout: str, sizes: tuple[int, int, int, int], is_fused: bool
) -> None:
    text = HEAD + turned(layout).replace("BODY", SCALED["query"] + " z = MatMul(w, vt)")
    dims = dict(zip((str(n) for n in (Q, K, H, C)), map(str, sizes), strict=True))
    # the first of a row of rows is the batch, 2 as well
    ports = re.compile(r"float\[(1,|2,)([\d,]+)\]")
    text = ports.sub(
        lambda m: f"float[{m[1]}{','.join(dims[d] for d in m[2].split(','))}]", text
    )

    result = apply(
        FuseKernels(), read(text.replace("SCALE", "1").replace("TIMES", "1"))
    )

    assert result.changes == is_fused
    assert is_fused or "its nodes are as fast" in result.notes[0]


def written(layout: str, scaled_by: str = "query", scale: float = C**-0.5) -> ir.Model:
    text = HEAD + turned(layout).replace(
        "BODY", SCALED[scaled_by] + " z = MatMul(w, vt)"
    )
    return read(text.replace("SCALE", str(scale)).replace("TIMES", str(1 / scale)))


def widened(model: ir.Model) -> ir.Model:
    """Return a graph of standard operators, in float64."""
    copy, _ = runnable.replace_fused(model.clone(), compiled=False)
    kind = ir.TensorType(ir.DataType.DOUBLE)
    for value in copy.graph.initializers.values():
        assert value.const_value is not None
        if value.const_value.dtype == ir.DataType.FLOAT:
            wide = value.const_value.numpy().astype(np.float64)
            value.const_value, value.type = ir.tensor(wide, name=value.name), kind
    for node in copy.graph:
        for value in node.outputs:
            value.type = value.shape = None
        if node.op_type == "Cast":
            node.attributes["to"] = ir.AttrInt64("to", ir.DataType.DOUBLE)
    for value in (*copy.graph.inputs, *copy.graph.outputs):
        value.type = kind
    del copy.graph.opset_imports["me2e"]
    return copy


@settings(max_examples=scaled(15))
@given(
    layout=st.sampled_from(sorted(LAYOUTS)),
    scaled_by=st.sampled_from(sorted(SCALED)),
    scale=st.sampled_from([C**-0.5, 0.5, -2.0]),
    seed=st.integers(0, 1000),
)
def test_fused_attention_is_the_same_in_float64(
    layout: str, scaled_by: str, scale: float, seed: int
) -> None:
    model = written(layout, scaled_by, scale)
    feeds = {name: each.astype(np.float64) for name, each in fed(model, seed).items()}
    plain = model.clone()
    plain.graph.opset_imports["me2e"] = 1
    wanted = compute(widened(plain), feeds)[0]

    assert apply(FuseKernels(), model).changes == 1

    assert np.allclose(compute(widened(model), feeds)[0], wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("layout", sorted(LAYOUTS))
def test_fused_attention_runs_as_its_nodes_do(layout: str) -> None:
    model = written(layout)
    feeds = fed(model, 0)
    wanted = Session(model.clone(), threads=1).run(feeds)["y"]

    apply(FuseKernels(), model)

    assert np.allclose(Session(model, threads=1).run(feeds)["y"], wanted, atol=1e-6)
    if layout == "heads in the batch":
        assert "Transpose" not in ops(model)
    if layout.startswith("side by side"):  # the transposes go
        assert ops(model) == [*["Reshape"] * 3, "MultiHeadAttention", "Reshape"]
        (fused,) = filter(find, model.graph)
        assert fused.attributes.get_int("heads") == H


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("w = Softmax<axis=-1>(b)", "w = Softmax<axis=2>(b)", "over the last axis"),
        ("(b) z", "(b) others = Abs(w) z", "others read its scores or weights"),
        ("w = Soft", "others = Soft", "others read its scores or weights"),
        ("b = Div(a, t)", "b = Div(a, t) others = Abs(a)", "others read its scores"),
        ("b = Div(a, t)", "b = Div(a, t) others = Abs(b)", "others read its scores"),
        ("w = Softmax<axis=-1>(b)", "c = Add(b, t) w = Softmax<axis=-1>(c)", "a mask"),
        ("float[1,2,70,16] k", "float[1,2,n,16] k", "its shapes are not known"),
        ("float[1,2,70,16] k", "float[1,1,70,16] k", "of different batches"),
        ("float[1,2,70,16] v", "float[1,1,70,16] v", "of different batches"),
        ("float[1,2,9,16] q", "float[1,2,7,16] q", "are few: 7 and 70"),
        ("70", "63", "are few: 9 and 63"),
        ("16", "129", "more than 128 channels"),
        ("float", "double", "it is not of float32 numbers"),
        (" : 17]", " : 12]", "need opset 13"),
        ("vt = Identity(v)", "vt = DequantizeLinear(i, t)", "its products are int8"),
    ],
)
def test_near_misses_stay_and_say_why(old: str, new: str, why: str) -> None:
    text = HEAD + turned("heads in the batch")
    text = text.replace("BODY", SCALED["query"] + " z = MatMul(w, vt)")
    text = text.replace("SCALE", "0.25").replace("TIMES", "4")
    if "Div" in old:
        text = text.replace(SCALED["query"], SCALED["product"])
    if "others" in new:
        text = text.replace("y)", f"y, float[1,{H},{Q},{K}] others)", 1)
    if "DequantizeLinear" in new:
        text = text.replace(f"float[1,{H},{K},{C}] v", f"int8[1,{H},{K},{C}] i")
    if "others = Soft" in new:
        text = text.replace("MatMul(w,", "MatMul(others,")
    assert old in text
    model = read(text.replace(old, new))

    result = apply(FuseKernels(), model)

    assert not result.changes
    assert why in "\n".join(result.notes)
    assert not any(find(node) for node in model.graph)


def test_a_query_that_is_a_vector_stays() -> None:
    model = read(
        HEAD + f"m (float[{C}] q, float[{C},{K}] k, float[{K},{C}] v) => (float[{C}] y)"
        "{ b = MatMul(q, k) w = Softmax<axis=-1>(b) y = MatMul(w, v) }"
    )

    (note,) = apply(FuseKernels(), model).notes

    assert note.endswith("one of its operands is a vector")
