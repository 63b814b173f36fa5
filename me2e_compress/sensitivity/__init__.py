"""Which modules and nodes int8 hurts, and which assignment fits a budget."""

from me2e_compress.sensitivity.analysis import Finding, Sensitivity, analyse
from me2e_compress.sensitivity.recipes import advise, write_recipe
from me2e_compress.sensitivity.search import Budget, Candidate, search
from me2e_compress.sensitivity.trials import Choice, Drive, Score, Trials

__all__ = [
    "Budget",
    "Candidate",
    "Choice",
    "Drive",
    "Finding",
    "Score",
    "Sensitivity",
    "Trials",
    "advise",
    "analyse",
    "search",
    "write_recipe",
]
