"""Hold a graph against the rules of the program that is to run it."""

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import RecipeError
from me2e_compress.targets.finding import LintFinding, LintRule, Severity
from me2e_compress.targets.onnxruntime.lint import RULES as ONNXRUNTIME_RULES
from me2e_compress.targets.tensorrt.lint import RULES as TENSORRT_RULES

__all__ = ["LINTS", "LintFinding", "LintRule", "Severity", "lint"]

LINTS: dict[str, tuple[LintRule, ...]] = {
    "tensorrt": TENSORRT_RULES,
    "onnxruntime": ONNXRUNTIME_RULES,
}


def lint(model: ir.Model, target: str) -> tuple[LintFinding, ...]:
    """List everything that is wrong with a graph for a target, errors first.

    Args:
        model: the graph; it stays as it is.
        target: ``tensorrt`` or ``onnxruntime``.

    Raises:
        RecipeError: there are no rules for such a target.
    """
    if target not in LINTS:
        raise RecipeError(f"no rules for target {target}; there are {', '.join(LINTS)}")
    copy = model.clone()
    graph.infer_shapes(copy)
    found = [finding for rule in LINTS[target] for finding in rule(copy)]
    return tuple(sorted(found, key=lambda each: each.severity))
