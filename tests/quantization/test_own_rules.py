"""Rules and sets of rules of the user, registered nowhere."""

import dataclasses
from collections.abc import Collection
from typing import ClassVar

import onnx_ir as ir
import pytest

from me2e_compress.manager import recipe
from me2e_compress.passes import PASSES, Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.costs import Border, Costs, CostsOf, Join, Loss
from me2e_compress.quantization.decision import Overrides, QuantPlan, QuantScheme
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS, Rule, RuleFacts, RuleSet
from me2e_compress.quantization.rules.rule_sets import PaperRules
from tests.support.nets import MODULES, conv_attention


@dataclasses.dataclass(frozen=True)
class NoConvolution(Rule):
    """Keep convolutions in float."""

    name: ClassVar[str] = "no-convolution"
    since: int = 0

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        return "it is a convolution" if node.op_type == "Conv" else None


@dataclasses.dataclass(frozen=True)
class Mine(RuleSet):
    """The paper's rules, and no convolution."""

    name: ClassVar[str] = "mine"

    def own_rules(self) -> tuple[Rule, ...]:
        return (*PaperRules().rules(), NoConvolution())


OWN = [Mine(), PaperRules(extra=(NoConvolution(),))]


@pytest.mark.parametrize("rules", OWN, ids=lambda rules: rules.name)
def test_they_decide(rules: RuleSet) -> None:
    plan = QuantizeInt8(rules=rules).plan(conv_attention(), Context(MODULES))

    assert plan.counts()["no-convolution"] == 1
    assert plan.rules == str(rules)


def test_a_pipeline_names_them() -> None:
    text = recipe.to_text((QuantizeInt8(rules=PaperRules(extra=(NoConvolution(3),))),))

    assert "no-convolution:3" in text
    assert PASSES.parse('quantize-int8{rules="paper"}') == QuantizeInt8(rules="paper")


# Int8 that does not pay stays float.


BOTH = QuantScheme.of(("backbone", "head"), MODULES)
A, B, C = (ir.node("Conv", [], name=name) for name in "abc")


def priced(costs: CostsOf | None, overrides: str = "") -> QuantPlan:
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
    decisions = {each.op: each for each in priced(dear).decisions}

    assert (decisions["Conv"].dtype, decisions["Conv"].rule) == ("float", "cost")
    assert decisions["Conv"].activations == ()
    assert decisions["Conv"].reason == (
        "int8 would save 2.0 µs of arithmetic and take 30.0 µs to quantize and"
        " dequantize on a slow bus"
    )
    slower = str(Loss(-2e-6, 30e-6, layers=3))
    assert slower.startswith("int8 would add 2.0 µs to arithmetic and take 30.0 µs")
    assert decisions["MatMul"].dtype == "int8"
    plan = priced(dear, '[[override]]\nop = "Conv"\ndtype = "int8"')  # it beats it
    assert [each.rule for each in plan.chosen if each.op == "Conv"] == ["override"]


def test_a_target_that_knows_no_costs_keeps_everything() -> None:
    assert priced(None).chosen == priced(lambda model, layers: None).chosen
    assert "cost" not in priced(None).counts()


@pytest.mark.parametrize(
    ("int8", "paid"),
    [
        ({A, B, C}, 0.0),  # made and read in int8
        ({B}, 1.0),  # quantized for its reader
        ({A}, 4.0),  # dequantized for each of its readers
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


def between(costs: float, readers: set[ir.Node], *makers: ir.Node) -> Border:
    return Border(
        costs, costs if makers else 0.0, frozenset(makers), frozenset(readers)
    )


@pytest.mark.parametrize(
    ("saved", "borders", "lost"),
    [
        # a slow layer between fast ones stays int8
        ({A: 9.0, B: -1.0, C: 9.0}, (between(1.0, {B}, A), between(1.0, {C}, B)), {}),
        # layers that only pay each other go together
        (
            {A: 1.0, B: 1.0, C: 9.0},
            (between(3.0, {A}), between(3.0, {B}, A)),
            dict.fromkeys((A, B), "(2 layers together)"),
        ),
        # a layer of unknown cost is not judged
        ({}, (Border(5.0, 5.0, readers=frozenset({A})),), {}),
    ],
)
def test_layers_that_lose_go(
    saved: dict[ir.Node, float], borders: tuple[Border, ...], lost: dict[ir.Node, str]
) -> None:
    losses = Costs("", saved, borders).losses(list(saved) or [A])

    assert list(losses) == list(lost)
    assert all(words in str(losses[node]) for node, words in lost.items())
