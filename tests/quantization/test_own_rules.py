"""Rules and sets of rules of the user, registered nowhere."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.errors import RecipeError
from me2e_compress.graph import static_shape
from me2e_compress.manager import recipe
from me2e_compress.passes import PASSES, Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.rules import RULE_SETS, Rule, RuleFacts, RuleSet
from me2e_compress.quantization.rules.rule_sets import PaperRules
from tests.installed import install
from tests.nets import MODULES, by_output, conv_attention, net, planned


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


# Rules and sets of rules of another package, which its entry points name.


PRODUCTS = (
    "p (float[9,32] x, float[32,32] w, float[32,64] v)"
    " => (float[9,32] y, float[9,64] z) { y = MatMul(x, w) z = MatMul(x, v) }"
)


@dataclass(frozen=True)
class OnlySmall(Rule):
    """Products of more than some columns stay float."""

    name: ClassVar[str] = "only-small"
    columns: int = 8

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        shape = static_shape(node.outputs[0])
        return "too wide" if shape and shape[-1] > self.columns else None


def test_a_rule_of_another_package_joins_a_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = {"only-small": f"{__name__}:OnlySmall"}
    install(monkeypatch, tmp_path, "a-rule", "me2e_compress.rules", entry)
    model = net(PRODUCTS, {"w": np.ones((32, 32)), "v": np.ones((32, 64))})

    plan = planned(model, "paper{extra=[only-small{columns=32}]}")

    assert by_output(plan)["y"].rule == "layer"
    assert by_output(plan)["z"].rule == "only-small"
    assert plan.rules == 'paper{extra=["only-small{columns=32}"]}'


@dataclass(frozen=True)
class NoRules(RuleSet):
    """Everything that can be is int8."""

    name: ClassVar[str] = "no-rules"

    def own_rules(self) -> tuple[Rule, ...]:
        return PaperRules().own_rules()[:3]


def test_a_set_of_another_package_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = {"no-rules": f"{__name__}:NoRules"}
    install(monkeypatch, tmp_path, "a-set", "me2e_compress.rule_sets", entry)
    model = net(PRODUCTS, {"w": np.ones((32, 32)), "v": np.ones((32, 64))})

    assert planned(model, "no-rules").counts()["layer"] == 2
    with pytest.raises(RecipeError, match="no-rules has no option 'attention_limit'"):
        QuantizeInt8(rules="no-rules", attention_limit=8).plan(model, Context(MODULES))
