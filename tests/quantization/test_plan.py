from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import ModuleMapError, RecipeError
from me2e_compress.commands.outcome import float_bytes
from me2e_compress.graph.modules.module_map import Module, ModuleMap
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.decision import Decision, QuantScheme, load_plan
from me2e_compress.quantization.plan import make_plan, tensors_of
from me2e_compress.quantization.rules import RuleSet
from me2e_compress.quantization.rules.rule_sets import PaperRules, SafeRules
from tests.support.calls import calls
from tests.support.nets import FULL, MODULES, PAPER, conv_attention, net

HEAD = QuantScheme.of(("head",), MODULES)

ATTENTION = """
attention (float[1,2,%(q)d,8] q, float[1,2,8,%(k)d] k, float[1,2,%(k)d,8] v,
           float[1,2,%(q)d,%(k)d] mask, bool[1,2,%(q)d,%(k)d] seen)
    => (float[1,2,%(q)d,8] y)
    <float scale = {0.35}, float low = {-10000.0}, float zero = {0.0},
     int64[1] last = {-1}> {
    %(body)s
}
"""

VARIANTS = {
    "plain": "s = MatMul(q, k) p = Softmax(s) y = MatMul(p, v)",
    "scaled by Mul": "t = Mul(q, scale) s = MatMul(t, k) u = Mul(s, scale)"
    " p = Softmax(u) y = MatMul(p, v)",
    "scaled by Div": "s = MatMul(q, k) u = Div(s, scale) p = Softmax(u)"
    " y = MatMul(p, v)",
    "additive mask": "s = MatMul(q, k) u = Add(mask, s) p = Softmax(u)"
    " y = MatMul(p, v)",
    "boolean Where": "s = MatMul(q, k) u = Where(seen, s, low) p = Softmax(u)"
    " y = MatMul(p, v)",
    "Sub": "s = MatMul(q, k) u = Sub(s, mask) p = Softmax(u) y = MatMul(p, v)",
    "Identity and Dropout": "s = MatMul(q, k) u = Identity(s) p = Softmax(u)"
    " d = Dropout(p) y = MatMul(d, v)",
    "Where after softmax": "s = MatMul(q, k) p = Softmax(s) w = Where(seen, p, zero)"
    " y = MatMul(w, v)",
    "softmax in five nodes": "s = MatMul(q, k) m = ReduceMax<axes=[-1]>(s)"
    " c = Sub(s, m) e = Exp(c) t = ReduceSum(e, last) p = Div(e, t) y = MatMul(p, v)",
    "Einsum": 's = Einsum<equation="bhqd,bhdk->bhqk">(q, k) p = Softmax(s)'
    ' y = Einsum<equation="bhqk,bhkd->bhqd">(p, v)',
}


def products(model: ir.Model) -> list[Decision]:
    plan = make_plan(model, HEAD, PAPER)
    return [each for each in plan.decisions if each.op in ("MatMul", "Einsum")]


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("q", "k"), [(600, 16), (16, 600)])
def test_long_attention_stays_float_however_it_is_written(
    variant: str, q: int, k: int
) -> None:
    text = ATTENTION % {"q": q, "k": k, "body": VARIANTS[variant]}
    found = products(net(text, {}))

    assert len(found) == 2
    for each in found:
        assert each.dtype == "float"
        if variant == "Einsum":
            assert each.rule == "operator"
            assert "attention" in each.reason
        else:
            assert each.rule == "attention-length"
            assert f"{q} queries and {k} keys, more than 512" in each.reason


@pytest.mark.parametrize("variant", [name for name in VARIANTS if name != "Einsum"])
def test_short_attention_becomes_int8_on_both_sides(variant: str) -> None:
    text = ATTENTION % {"q": 512, "k": 16, "body": VARIANTS[variant]}
    found = products(net(text, {}))

    assert [each.dtype for each in found] == ["int8", "int8"]
    assert all(each.rule == "attention" for each in found)
    assert all(each.activations == (0, 1) and each.weight is None for each in found)


def test_a_product_without_softmax_is_no_layer() -> None:
    body = "s = MatMul(q, k) y = MatMul(s, v)"
    found = products(net(ATTENTION % {"q": 16, "k": 16, "body": body}, {}))

    assert {(each.dtype, each.rule) for each in found} == {("float", "weight")}


def test_sampling_weights_are_a_layer_not_an_attention() -> None:
    text = """
    weights (float[1,900,8] x, float[8,4] w, float[4] b) => (float[1,900,4] y) {
        s = MatMul(x, w)
        t = Add(s, b)
        y = Softmax(t)
    }
    """
    (found,) = products(net(text, {"w": np.ones((8, 4)), "b": np.ones(4)}))

    assert (found.dtype, found.rule) == ("int8", "layer")


LINEAR = """
linear (float[%s] x, float[%s] w) => (float[%s] y) { y = MatMul(x, w) }
"""


@pytest.mark.parametrize(
    ("x", "w", "y", "rule"),
    [
        ("1,64", "64,32", "1,32", "gemv"),
        ("1,1,64", "64,32", "1,1,32", "gemv"),
        ("1,1,1,64", "64,32", "1,1,1,32", "gemv"),
        ("7,64", "64,1", "7,1", "gemv"),
        ("1,7,64", "64,1", "1,7,1", "gemv"),
        ("2,3,7,64", "64,1", "2,3,7,1", "gemv"),
        ("7,64", "64,32", "7,32", "layer"),
        ("1,2,64", "64,32", "1,2,32", "layer"),
        ("2,1,64", "64,32", "2,1,32", "layer"),
        ("2,1,64", "2,64,32", "2,1,32", "gemv"),
    ],
)
def test_matrix_vector_products_stay_float_at_any_rank(
    x: str, w: str, y: str, rule: str
) -> None:
    shape = [int(size) for size in w.split(",")]
    (found,) = products(net(LINEAR % (x, w, y), {"w": np.ones(shape)}))

    assert found.rule == rule
    assert found.dtype == ("int8" if rule == "layer" else "float")


@pytest.mark.parametrize("flip", [0, 1])
@pytest.mark.parametrize(("rows", "rule"), [(1, "gemv"), (3, "layer")])
def test_gemm_counts_rows_of_what_it_multiplies(
    flip: int, rows: int, rule: str
) -> None:
    shape = (6, 4) if flip else (4, 6)
    text = f"""
    gemm (float[{rows},4] x, float[{shape[0]},{shape[1]}] w) => (float[{rows},6] y) {{
        y = Gemm<transB={flip}>(x, w)
    }}
    """
    plan = make_plan(net(text, {"w": np.ones(shape)}), HEAD, PAPER)

    assert plan.decisions[0].rule == rule


def test_weights_that_are_turned_at_run_time_are_weights() -> None:
    text = """
    turned (float[2,4] x, float[6,4] w) => (float[2,6] y) {
        t = Transpose(w)
        y = MatMul(x, t)
    }
    """
    (found,) = products(net(text, {"w": np.ones((6, 4))}))

    assert (found.rule, found.axis) == ("layer", 1)


def test_a_constant_on_the_left_is_coordinate_arithmetic() -> None:
    (found,) = products(net(LINEAR % ("5,4", "4,6", "5,6"), {"x": np.ones((5, 4))}))

    assert (found.dtype, found.rule) == ("float", "weight")
    assert "left operand is constant" in found.reason


def test_every_node_has_a_decision_a_module_and_a_reason() -> None:
    model = conv_attention()

    plan = make_plan(model, FULL, PAPER)

    assert [each.node for each in plan.decisions] == [node.name for node in model.graph]
    assert all(each.reason and each.module for each in plan.decisions)
    assert [each.node for each in plan.chosen] == [
        "/backbone/Conv", "/head/QK", "/head/AV", "/head/Linear",
    ]  # fmt: skip
    assert tensors_of(plan, model) == ("image", "q", "seen", "p", "mixed")
    assert plan.counts() == {"attention": 2, "layer": 2}


@pytest.mark.parametrize(
    ("scheme", "nodes"),
    [
        ("feature-ext", ["/backbone/Conv"]),
        ("prediction", ["/head/QK", "/head/AV", "/head/Linear"]),
    ],
)
def test_schemes_go_by_the_role_of_modules(scheme: str, nodes: list[str]) -> None:
    plan = make_plan(conv_attention(), QuantScheme.named(scheme, MODULES), PAPER)

    assert [each.node for each in plan.chosen] == nodes


def test_unknown_schemes_and_modules_are_errors() -> None:
    with pytest.raises(RecipeError, match=r"no scheme int4; .*feature-ext"):
        QuantScheme.named("int4", MODULES)
    with pytest.raises(ModuleMapError, match=r"occ: .*backbone, head"):
        QuantScheme.of(("occ",), MODULES)


def diamonds(count: int) -> ir.Model:
    """Sampling-point arithmetic: each step reads the one before twice."""
    body = ["s0 = MatMul(q, k)"]
    for i in range(count):
        body += [f"a{i} = Mul(s{i}, scale)", f"b{i} = Add(s{i}, mask)"]
        body += [f"s{i + 1} = Add(a{i}, b{i})", f"p{i} = Softmax(s{i + 1})"]
    body += [f"y = MatMul(p{count - 1}, v)"]
    return net(ATTENTION % {"q": 16, "k": 16, "body": "\n".join(body)}, {})


@pytest.mark.parametrize("rules", [PaperRules(), SafeRules()])
def test_planning_is_linear_on_diamonds_and_on_many_softmaxes(rules: RuleSet) -> None:
    few, many = diamonds(50), diamonds(400)

    # eight times the nodes; quadratic would be 64 times the calls
    assert calls(lambda: make_plan(many, HEAD, rules)) < 12 * calls(
        lambda: make_plan(few, HEAD, rules)
    )
    assert sum(make_plan(many, HEAD, rules).counts().values()) == 2


OPEN = """
batch (float[N,%s,8] a, float[N,8,%s] b, float[N,%s,8] c) => (float[N,%s,8] y) {
    s = MatMul(a, b)
    p = Softmax(s)
    y = MatMul(p, c)
}
"""


@pytest.mark.parametrize(
    ("sizes", "rule"),
    [
        ((16, 16, 16, 16), "attention"),
        ((16, 600, 600, 16), "attention-length"),
        ((1, 16, 16, 1), "gemv"),
        (("Q", 16, 16, "Q"), "attention-length"),
    ],
)
def test_an_open_batch_changes_no_decision(
    sizes: tuple[int | str, ...], rule: str
) -> None:
    plan = make_plan(net(OPEN % sizes, {}), HEAD, PAPER)

    assert [each.rule for each in plan.decisions if each.op == "MatMul"] == [rule] * 2


# Plans on disk, in a model, and side by side.


def test_no_such_plan(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"none\.json: no such plan"):
        load_plan(tmp_path / "none.json")


# A scheme of a part of the graph needs a map that tells the parts apart.


@pytest.mark.parametrize("scheme", ["feature-ext", "prediction"])
def test_a_part_of_a_graph_without_parts_is_refused(scheme: str) -> None:
    with pytest.raises(ModuleMapError, match=f"{scheme} is of a part .* map whole"):
        QuantScheme.named(scheme, ModuleMap.whole())

    heads = ModuleMap("heads", (Module("planner", "prediction", ("head",)),))
    with pytest.raises(ModuleMapError, match="no module of role feature"):
        QuantScheme.named(scheme, heads)
    assert QuantScheme.named("full", ModuleMap.whole()).modules == ("model",)


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


def test_weights_that_stay_float_are_counted_by_rule() -> None:
    shapes = {"layer": (32, 64), "table": (64, 64), "small": (8,)}
    shapes |= dict.fromkeys(("recurrent", "step"), (1, 256, 64))
    model = net(TEXT, {name: np.ones(shape) for name, shape in shapes.items()})
    counts = [
        float_bytes(model, QuantizeInt8(scheme=m, rules="paper").plan(model, context))
        for context in (Context(MODULES),)
        for m in (("backbone", "head"), ("head",))
    ]

    operator = 4 * (2 * 256 * 64 + 64 * 64)
    assert counts == [{"operator": operator}, {"operator": operator, "module": 8192}]
