"""Rules and sets of rules of the user, registered nowhere."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir
import pytest

from me2e_compress.manager import recipe
from me2e_compress.passes import PASSES, Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.rules import RULE_SETS, Rule, RuleFacts, RuleSet
from me2e_compress.quantization.rules.rule_sets import PaperRules
from tests.nets import MODULES, conv_attention


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


def test_options_of_the_pass_reach_them() -> None:
    quantizer = QuantizeInt8(rules=Mine(), without=("gemv", "no-convolution"))

    plan = quantizer.plan(conv_attention(), Context(MODULES))

    assert "no-convolution" not in plan.counts()


def test_a_pipeline_names_them() -> None:
    text = recipe.to_text((QuantizeInt8(rules=PaperRules(extra=(NoConvolution(3),))),))

    assert "no-convolution:3" in text
    assert PASSES.parse('quantize-int8{rules="paper"}') == QuantizeInt8(rules="paper")


def test_a_registered_set_as_an_object_is_written_as_its_text() -> None:
    rules = RULE_SETS.parse("paper{without=[gemv]}")
    text = recipe.to_text((QuantizeInt8(rules=rules),))
    (back,) = recipe.parse(text)

    assert isinstance(back, QuantizeInt8)
    assert RULE_SETS.parse(str(back.rules)) == rules
