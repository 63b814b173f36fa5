"""Int8 that does not pay stays float."""

from collections.abc import Collection

import onnx_ir as ir
import pytest

from me2e_compress.quantization.costs import Border, Costs, CostsOf, Join
from me2e_compress.quantization.plan import Overrides, QuantPlan, make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from tests.nets import MODULES, conv_attention

BOTH = QuantScheme.of(("backbone", "head"), MODULES)
A, B, C = (ir.node("Conv", [], name=name) for name in "abc")
ALL = frozenset({A, B, C})


def planned(costs: CostsOf | None, overrides: str = "") -> QuantPlan:
    rules = RULE_SETS.parse("paper{extra=[cost]}")
    pins = Overrides.parse(overrides)
    return make_plan(conv_attention(), BOTH, rules, pins, costs)


def dear(model: ir.Model, layers: Collection[ir.Node]) -> Costs:
    """The convolution saves 2 µs and pays 30 at its borders."""
    borders = tuple(
        Border(30e-6, 0.0, readers=frozenset({layer}))
        for layer in layers
        if layer.op_type == "Conv"
    )
    return Costs("a slow bus", dict.fromkeys(layers, 2e-6), borders)


def test_a_layer_that_pays_more_than_it_saves_stays_float() -> None:
    decisions = {each.op: each for each in planned(dear).decisions}

    assert (decisions["Conv"].dtype, decisions["Conv"].rule) == ("float", "cost")
    assert decisions["Conv"].activations == ()
    assert decisions["Conv"].reason == (
        "int8 would save 2.0 µs of arithmetic and take 30.0 µs to quantize and"
        " dequantize on a slow bus"
    )
    assert decisions["MatMul"].dtype == "int8"


def test_a_target_that_knows_no_costs_keeps_everything() -> None:
    assert planned(None).chosen == planned(lambda model, layers: None).chosen
    assert "cost" not in planned(None).counts()


def test_an_override_beats_it() -> None:
    plan = planned(dear, '[[override]]\nop = "Conv"\ndtype = "int8"')

    assert [each.rule for each in plan.chosen if each.op == "Conv"] == ["override"]


@pytest.mark.parametrize(
    ("int8", "paid"),
    [
        ({A, B, C}, 0.0),  # made and read in int8
        ({B}, 1.0),  # quantized for its reader
        ({A}, 2.0),  # dequantized for its readers
        ({A, B}, 2.0),  # dequantized for one of them
        (set(), 0.0),
    ],
)
def test_a_border_costs_where_int8_begins_or_ends(
    int8: set[ir.Node], paid: float
) -> None:
    border = Border(1.0, 2.0, frozenset({A}), frozenset({B, C}))

    assert border.paid_s(int8) == paid


@pytest.mark.parametrize(
    ("int8", "paid"), [({A, B}, 0.0), ({A}, 2.0), ({B}, 0.0), ({B, C}, 1.0)]
)
def test_a_join_is_int8_between_int8(int8: set[ir.Node], paid: float) -> None:
    join = Join(frozenset({A, C}), frozenset({B}))
    border = Border(1.0, 2.0, frozenset({A}), joins=(join,))

    assert border.paid_s(int8) == paid


def test_a_slow_layer_between_fast_ones_stays_int8() -> None:
    saved = {A: 9.0, B: -1.0, C: 9.0}
    borders = (
        Border(1.0, 1.0, frozenset({A}), frozenset({B})),
        Border(1.0, 1.0, frozenset({B}), frozenset({C})),
    )

    assert Costs("", saved, borders).losses([A, B, C]) == {}


def test_layers_that_only_pay_each_other_go_together() -> None:
    saved = {A: 1.0, B: 1.0, C: 9.0}
    borders = (
        Border(3.0, 0.0, readers=frozenset({A})),
        Border(3.0, 3.0, frozenset({A}), frozenset({B})),
    )
    losses = Costs("", saved, borders).losses([A, B, C])

    assert list(losses) == [A, B]
    assert "(2 layers together)" in str(losses[A])


def test_a_layer_of_unknown_cost_is_not_judged() -> None:
    borders = (Border(5.0, 5.0, readers=frozenset({A})),)

    assert Costs("", {}, borders).losses([A]) == {}
