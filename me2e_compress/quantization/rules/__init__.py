"""Why a node stays in float: small rules, asked in order, the first answer counts.

To add a rule or a set of rules: write its class, then add it to its table in ``base``.
"""

from me2e_compress.quantization.rules.base import (
    DEFAULT_RULES,
    RULE_SETS,
    RULES,
    Rule,
    RuleFacts,
    RuleSet,
)

__all__ = [
    "DEFAULT_RULES",
    "RULES",
    "RULE_SETS",
    "Rule",
    "RuleFacts",
    "RuleSet",
]
