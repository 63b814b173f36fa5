"""Evaluators: they drive a compressed model, or read how it drove.

To add an evaluator: write its class, then add it to this table.
"""

from me2e_compress.driving.contract import Evaluator
from me2e_compress.errors import EvaluationError
from me2e_compress.registry import Registry

__all__ = ["EVALUATORS", "Evaluator"]

_HERE = "me2e_compress.evaluators"

EVALUATORS: Registry[Evaluator] = Registry(
    "evaluator",
    _HERE,
    EvaluationError,
    {
        "highway": f"{_HERE}.highway.evaluator:HighwayEvaluation",
        "bench2drive": f"{_HERE}.bench2drive.real_results:Bench2DriveResults",
    },
)
