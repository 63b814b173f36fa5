"""Why a node stays in float: small rules, asked in order, the first answer counts.

To add a rule or a set of rules: write its class, then add it to its table in ``base``.
"""

from me2e_compress.quantization.rules.base import (
    CONVOLUTIONS,
    RULE_SETS,
    RULES,
    WEIGHTED,
    Facts,
    Rule,
    RuleSet,
)

__all__ = [
    "CONVOLUTIONS",
    "RULES",
    "RULE_SETS",
    "WEIGHTED",
    "Facts",
    "Rule",
    "RuleSet",
]
