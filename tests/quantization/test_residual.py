"""Adds behind convolutions, and scales that belong together."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph.rewrite import add_constant
from me2e_compress.quantization.decision import Decision, Overrides, QuantPlan
from me2e_compress.quantization.plan import make_plan, share_scales
from me2e_compress.quantization.rules import RULE_SETS
from tests.support.nets import FULL, PAPER, net

BLOCK = """
block (float[1,16,8,8] x, float[16,16,1,1] w1, float[16,16,1,1] w2,
       float[16,16,1,1] w3, float[16] b, float[16,16,1,1] w4) => (float[1,16,8,8] y) {
    ["/backbone/1"] a = Conv(x, w1)
    ["/backbone/2"] r = Relu(a)
    ["/backbone/3"] main = Conv(r, w2)
    ["/backbone/4"] %s
    ["/backbone/5"] s = Add(%s)
    ["/backbone/6"] y = Relu(s)
}
"""
WEIGHTS = {name: np.ones((16, 16, 1, 1)) for name in ("w1", "w2", "w3", "w4")}


def block(branch: str, operands: str) -> ir.Model:
    return net(BLOCK % (branch, operands), {**WEIGHTS, "b": np.ones(16)})


def addition(plan: QuantPlan) -> Decision:
    return next(each for each in plan.decisions if each.op == "Add")


@pytest.mark.parametrize(
    ("branch", "operands", "residual"),
    [
        ("same = Identity(x)", "main, x", 1),
        ("same = Identity(x)", "x, main", 0),
        # a projection is the shorter of two branches that end in a convolution
        ("down = Conv(x, w3)", "main, down", 1),
        ("down = Conv(x, w3)", "down, main", 0),
    ],
)
def test_the_residual_branch_is_read_as_int8(
    branch: str, operands: str, residual: int
) -> None:
    found = addition(make_plan(block(branch, operands), FULL, PAPER))

    assert (found.dtype, found.rule) == ("int8", "residual")
    assert found.activations == (residual,)
    assert found.weight is None


@pytest.mark.parametrize(
    ("branch", "operands"),
    [
        ("bias = Relu(main)", "x, bias"),  # no convolution ends here
        ("other = Relu(main)", "main, x"),  # the convolution is read elsewhere too
        ("row = ReduceMean<axes=[2]>(x)", "main, row"),  # a broadcast
    ],
)
def test_other_adds_stay_float(branch: str, operands: str) -> None:
    found = addition(make_plan(block(branch, operands), FULL, PAPER))

    assert (found.dtype, found.rule) == ("float", "operator")


def test_an_add_of_a_constant_is_no_residual() -> None:
    model = block("same = Identity(x)", "main, x")
    node = next(each for each in model.graph if each.op_type == "Add")
    table = add_constant(model.graph, np.ones((1, 16, 8, 8), np.float32), "table")
    node.replace_input_with(1, table)

    assert addition(make_plan(model, FULL, PAPER)).dtype == "float"


def test_a_batch_normalization_does_not_hide_the_convolution() -> None:
    branch = "n = BatchNormalization(main, b, b, b, b)"

    found = addition(make_plan(block(branch, "n, x"), FULL, PAPER))

    assert (found.rule, found.activations) == ("residual", (1,))


@pytest.mark.parametrize(
    ("kept", "rule", "layers"),
    [('nodes = "/backbone/3"', "operator", 1), ('op = "Add"', "override", 2)],
)
def test_the_add_goes_with_its_convolution_and_can_be_kept_in_float_alone(
    kept: str, rule: str, layers: int
) -> None:
    overrides = Overrides.parse(f'[[override]]\n{kept}\ndtype = "float"')

    plan = make_plan(block("i = Identity(x)", "main, x"), FULL, PAPER, overrides)

    assert (addition(plan).dtype, addition(plan).rule) == ("float", rule)
    assert plan.counts()["layer"] == layers


CONCAT = """
join (float[9,16] a, float[9,16] b, float[9,16] c, float[16,16] w, float[48,16] v,
      float[80,16] u) => (float[9,16] k, float[9,16] l, float[9,16] m, float[9,16] n) {
    ["/head/A"] k = MatMul(a, w)
    ["/head/B"] l = MatMul(b, w)
    ["/head/Concat"] ab = Concat<axis=1>(a, b, c)
    ["/head/AB"] m = MatMul(ab, v)
    ["/head/Outer"] abc = Concat<axis=1>(ab, a, b)
    ["/head/ABC"] n = MatMul(abc, u)
}
"""


def joined(rules: str = "safe") -> QuantPlan:
    model = net(
        CONCAT, {"w": np.ones((16, 16)), "v": np.ones((48, 16)), "u": np.ones((80, 16))}
    )
    return make_plan(model, FULL, RULE_SETS.parse(rules))


def concats(plan: QuantPlan) -> list[tuple[str, set[str]]]:
    return [(g.name, set(g.tensors)) for g in plan.groups]


RANGES = Ranges(
    {"a": (-1.0, 1.0), "b": (-4.0, 2.0), "ab": (-4.0, 4.0), "abc": (-4.0, 4.0)},
    "max-min",
    1,
    "",
    "",
)


def test_concats_of_concats_are_one_group() -> None:
    assert concats(joined()) == [("/head/Outer", {"a", "b", "ab", "abc"})]


def test_the_paper_shares_no_scales() -> None:
    plan = joined(rules="paper")

    assert concats(plan) == []
    assert share_scales(plan, RANGES) == RANGES


def test_a_group_has_the_widest_range() -> None:
    assert set(share_scales(joined(), RANGES).tensors.values()) == {(-4.0, 4.0)}
