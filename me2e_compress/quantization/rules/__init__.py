"""Why a node stays in float: small rules, asked in order, the first answer counts.

A rule set is a name and a tuple of rules: leave one out to switch it off.
"""

import dataclasses
from collections.abc import Collection
from typing import Self

from me2e_compress.errors import RecipeError
from me2e_compress.quantization.rules.base import (
    CONVOLUTIONS,
    WEIGHTED,
    Facts,
    Rule,
)
from me2e_compress.quantization.rules.kernel_limits import (
    NarrowConvolution,
    SmallProduct,
)
from me2e_compress.quantization.rules.positions import Coordinates
from me2e_compress.quantization.rules.scope import (
    ModuleScope,
    WeightedOperator,
    WeightOperand,
)
from me2e_compress.quantization.rules.stages import AttentionLength, MatrixVector

__all__ = [
    "CONVOLUTIONS",
    "RULE_SETS",
    "WEIGHTED",
    "AttentionLength",
    "Coordinates",
    "Facts",
    "MatrixVector",
    "ModuleScope",
    "NarrowConvolution",
    "Rule",
    "RuleSet",
    "SmallProduct",
    "WeightOperand",
    "WeightedOperator",
    "paper_rules",
    "rules_named",
    "tensorrt_rules",
]

RULE_SETS = ("paper", "tensorrt")


@dataclasses.dataclass(frozen=True)
class RuleSet:
    """Rules that are asked together.

    Attributes:
        name: what plans call it.
        rules: in the order in which they are asked.
        share_concat: whether what a Concat joins is put on one scale with what it
            gives, so that it moves int8 without requantizing.
    """

    name: str
    rules: tuple[Rule, ...]
    share_concat: bool = False

    def without(self, names: Collection[str]) -> Self:
        """Switch some rules off.

        Raises:
            RecipeError: it has no such rule, or none that can be switched off.
        """
        loose = [rule.id for rule in self.rules if not rule.firm]
        for name in names:
            if name not in loose:
                raise RecipeError(
                    f"rule {name} cannot be switched off; of {self.name} can"
                    f" {', '.join(loose)}"
                )
        kept = tuple(rule for rule in self.rules if rule.id not in names)
        return dataclasses.replace(self, rules=kept)


def paper_rules(attention_limit: int = 512) -> RuleSet:
    """Give the rule set of the paper: its two stages, and what is no layer at all."""
    return RuleSet("paper", _paper(attention_limit))


def tensorrt_rules(attention_limit: int = 512) -> RuleSet:
    """Give the paper's rules and what TensorRT and coordinates need beyond them."""
    more = (SmallProduct(), NarrowConvolution(), Coordinates())
    return RuleSet("tensorrt", (*_paper(attention_limit), *more), share_concat=True)


def rules_named(name: str, attention_limit: int = 512) -> RuleSet:
    """Give a rule set by its name.

    Raises:
        RecipeError: there is no such set.
    """
    if name == "paper":
        return paper_rules(attention_limit)
    if name == "tensorrt":
        return tensorrt_rules(attention_limit)
    raise RecipeError(f"no rule set {name}; there are {', '.join(RULE_SETS)}")


def _paper(attention_limit: int) -> tuple[Rule, ...]:
    return (
        WeightedOperator(),
        ModuleScope(),
        WeightOperand(),
        AttentionLength(attention_limit),
        MatrixVector(),
    )
