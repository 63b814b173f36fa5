"""Which products are one attention, where several stand close together."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import RecipeError
from me2e_compress.graph.nodes import constant_values
from me2e_compress.quantization.decision import Decision, Overrides, QuantScheme
from me2e_compress.quantization.find_attention import Attention, find_attention
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.targets import TARGETS
from tests.support.nets import MODULES, net

HEAD = '<ir_version: 9, opset_import: ["" : 17, "com.microsoft" : 1, "trt" : 1]>\n'


def found(text: str, domain: str = HEAD) -> dict[str, Attention]:
    model = net(domain + text, {})
    attention = find_attention(model, constant_values(model))
    return {str(node.outputs[0].name): each for node, each in attention.items()}


SHARED_MASK = """
    two (float[1,2,30,8] a, float[1,2,8,700] b, float[1,2,700,8] c,
         float[1,2,30,8] d, float[1,2,8,40] e, float[1,2,40,8] f,
         float[1,1,4] m, float[1,4,1] n) => (float[1,2,30,8] y, float[1,2,30,8] z) {
        common = MatMul(m, n)
        s = MatMul(a, b)
        masked = Add(s, common)
        p = Softmax(masked)
        y = MatMul(p, c)
        t = MatMul(d, e)
        covered = Add(common, t)
        q = Softmax(covered)
        z = MatMul(q, f)
    }
"""
"""The mask is made of a product of its own, reached from both."""
CHAIN = """
    chain (float[2,8] x, float[8,9] k, float[9,8] v, float[8,7] l, float[7,5] w)
        => (float[2,5] y) {
        s = MatMul(x, k)
        p = Softmax(s)
        mixed = MatMul(p, v)
        t = MatMul(mixed, l)
        q = Softmax(t)
        y = MatMul(q, w)
    }
"""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (SHARED_MASK, {"s": (30, 700), "y": (30, 700), "t": (30, 40), "z": (30, 40)}),
        (CHAIN, {"s": (2, 9), "mixed": (2, 9), "t": (2, 7), "y": (2, 7)}),
    ],
)
def test_attentions_beside_or_behind_each_other_keep_their_own_lengths(
    text: str, expected: dict[str, tuple[int, int]]
) -> None:
    told = {name: (each.queries, each.keys) for name, each in found(text).items()}
    assert told == expected


def test_two_products_added_up_are_one_attention() -> None:
    """Relative positions: queries by keys and queries by positions."""
    text = """
    relative (float[6,8] q, float[8,9] k, float[8,9] r, float[9,8] v)
        => (float[6,8] y) {
        s = MatMul(q, k)
        t = MatMul(q, r)
        u = Add(s, t)
        p = Softmax(u)
        y = MatMul(p, v)
    }
    """
    assert found(text) == dict.fromkeys("sty", Attention(6, 9))


@pytest.mark.parametrize(
    "call",
    [
        "y = com.microsoft.MultiHeadAttention<num_heads=2>(q, k, v)",
        "y = trt.QKVTRT(q, k, v)",
    ],
)
def test_fused_attention_says_how_long_it_is(call: str) -> None:
    text = f"""
    fused (float[1,600,8] q, float[1,30,8] k, float[1,30,8] v)
        => (float[1,600,8] y) {{ {call} }}
    """
    assert found(text) == {"y": Attention(600, 30)}


def test_learned_keys_of_several_heads_are_keys() -> None:
    model = net(
        HEAD + "learned (float[1,2,5,8] q, float[1,2,8,6] k, float[1,2,6,8] v)"
        " => (float[1,2,5,8] y) { s = MatMul(q, k) p = Softmax(s) y = MatMul(p, v) }",
        {"k": np.ones((1, 2, 8, 6))},
    )

    attention = find_attention(model, constant_values(model))

    sizes = [max(each.queries or 0, each.keys or 0) for each in attention.values()]
    assert sizes == [6, 6]


def test_heads_written_out_one_by_one_are_found() -> None:
    heads = 12
    lines = [
        f"v{i} = Mul(v, g) h{i} = MatMul(p, v{i}) o{i} = Relu(h{i})"
        for i in range(heads)
    ]
    total = ", ".join(f"o{i}" for i in range(heads))
    text = (
        "heads (float[5,8] q, float[8,9] k, float[9,8] v, float g) => (float[5,96] y)"
        f" {{ s = MatMul(q, k) p = Softmax(s) {' '.join(lines)}"
        f" y = Concat<axis=1>({total}) }}"
    )
    assert len(found(text)) == 1 + heads


@pytest.mark.parametrize(
    ("batch", "keys", "mask"),
    [("N", 700, ""), ("1", None, ""), ("N", 700, "mask = MatMul(m, n)")],
)
def test_an_open_batch_leaves_the_lengths_known(
    batch: str, keys: int | None, mask: str
) -> None:
    """And a mask of another length is no product of keys."""
    k = keys or "K"
    added = f"t = Mul(s, s) {mask} u = Add(t, mask)" if mask else "u = Identity(s)"
    text = f"""
    batch (float[{batch},30,8] a, float[{batch},8,{k}] b, float[{batch},{k},8] c,
           float[{batch},30,4] m, float[{batch},4,1] n) => (float[{batch},30,8] y) {{
        s = MatMul(a, b) {added} p = Softmax(u) y = MatMul(p, c)
    }}
    """
    assert found(text) == {"s": Attention(30, keys), "y": Attention(30, keys)}


# Fused operators in a plan: a decision with a reason, as for any layer.


SCHEME = QuantScheme.of(("head",), MODULES)
SAMPLED = """
<ir_version: 9, opset_import: ["" : 17, "DOMAIN" : 1]>
net (TYPE[1,63,3,8] value, TYPE[1,50,3,2,4,2] at, TYPE[1,50,3,2,4] shares)
    => (TYPE[1,50,3,8] y)
<int32[2,2] sizes = {5, 11, 2, 4}, int32[2] starts = {0, 55}> {
    ["/head/sampled"] y = DOMAIN.NAME(value, sizes, starts, at, shares)
}
"""
TO_INT8 = Overrides.parse('[[override]]\nnodes = "/head/sampled"\ndtype = "int8"')


def sampled(
    domain: str = "me2e",
    name: str = "MultiScaleDeformableAttention",
    kind: str = "float",
    **weights: npt.NDArray[np.float64],
) -> ir.Model:
    text = SAMPLED.replace("DOMAIN", domain).replace("NAME", name)
    return net(text.replace("TYPE", kind), weights)


def decided(
    model: ir.Model,
    rules: str = "safe",
    *,
    target: str = "onnxruntime",
    scheme: QuantScheme = SCHEME,
    overrides: Overrides | None = None,
) -> Decision:
    found = TARGETS.parse(target)
    chosen, pins = RULE_SETS.parse(rules), overrides or Overrides()
    plan = make_plan(model, scheme, chosen, pins, fused=found.fused_objection)
    return plan.decisions[-1]


def test_its_features_become_int8_and_nothing_else() -> None:
    found = decided(sampled())

    assert (found.dtype, found.rule, found.activations) == ("int8", "sampled", (0,))
    assert "positions and weights stay float" in found.reason


def test_the_paper_quantizes_weighted_layers_alone() -> None:
    found = decided(sampled(), "paper")

    assert (found.dtype, found.rule) == ("float", "fused-operator")
    assert found.could_be_int8  # so that `plan -v` shows it
    assert decided(sampled(), "paper{without=[fused-operator]}").dtype == "int8"
    assert decided(sampled(), "paper", overrides=TO_INT8).rule == "override"


def test_modules_outside_the_scheme_stay() -> None:
    backbone = QuantScheme.of(("backbone",), MODULES)

    assert decided(sampled(), scheme=backbone).rule == "module"


@pytest.mark.parametrize(
    ("domain", "name", "reason"),
    [
        ("trt.plugins", "MultiscaleDeformableAttnPlugin_TRT", "float32 or float16"),
        ("mmdeploy", "MMCVMultiScaleDeformableAttention", "float32 or float16"),
        ("trt.plugins", "MultiScaleDeformableAttnTRT", "not by QDQ"),
    ],
)
def test_plugins_of_tensorrt_stay_whatever_is_asked(
    domain: str, name: str, reason: str
) -> None:
    model = sampled(domain, name)
    found = decided(model, target="tensorrt")

    assert (found.dtype, found.rule) == ("float", "operator")
    assert reason in found.reason
    with pytest.raises(RecipeError, match=reason):
        decided(model, target="tensorrt", overrides=TO_INT8)


def test_operators_that_declare_nothing_stay() -> None:
    model = net(
        '<ir_version: 9, opset_import: ["" : 17, "me2e" : 1]>\n'
        "net (float[3,8,8] x, float[1] a, float[2] c) => (float[3,8,8] y)"
        " { y = me2e.Rotate(x, a, c) }",
        {},
    )

    assert decided(model).reason == "Rotate is not a weighted layer"


def test_constant_features_stay() -> None:
    model = sampled(value=np.ones((1, 63, 3, 8)))

    assert decided(model).reason == "what it samples is constant"


def test_features_in_float16_stay() -> None:
    assert decided(sampled(kind="float16")).rule == "weight"
