"""Which modules and nodes int8 hurts, and which assignment fits a budget."""

from me2e_compress.fidelity.sensitivity.analysis import (
    ModuleSensitivity,
    Sensitivity,
    analyse,
)
from me2e_compress.fidelity.sensitivity.recipes import advise, write_recipe
from me2e_compress.fidelity.sensitivity.search import Budget, Candidate, search
from me2e_compress.fidelity.sensitivity.trials import Int8Choice, Score, Trials

__all__ = [
    "Budget",
    "Candidate",
    "Int8Choice",
    "ModuleSensitivity",
    "Score",
    "Sensitivity",
    "Trials",
    "advise",
    "analyse",
    "search",
    "write_recipe",
]
