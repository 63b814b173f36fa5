"""Which modules and nodes int8 hurts, and which assignment fits a budget."""

from me2e_compress.fidelity.sensitivity.analysis import (
    Int8Choice,
    ModuleSensitivity,
    Score,
    Sensitivity,
    Trials,
    advise,
    analyse,
    write_recipe,
)
from me2e_compress.fidelity.sensitivity.search import Budget, Candidate, search

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
