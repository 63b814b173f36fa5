"""Evaluators: they drive a compressed model, or read how it drove.

To add an evaluator: write its class, then add it to the table in `contract`.
"""

from me2e_compress.evaluators.contract import EVALUATORS, Drive, Evaluator

__all__ = ["EVALUATORS", "Drive", "Evaluator"]
