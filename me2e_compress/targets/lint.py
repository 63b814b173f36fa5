"""Hold a graph against the rules of the program that is to run it."""

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.targets import TARGETS
from me2e_compress.targets.finding import LintFinding, LintRule, Severity

__all__ = ["LintFinding", "LintRule", "Severity", "lint"]


def lint(model: ir.Model, target: str) -> tuple[LintFinding, ...]:
    """List everything that is wrong with a graph for a target, errors first.

    Args:
        model: the graph; it stays as it is.
        target: its name, with options where it has any.

    Raises:
        RecipeError: there is no such target.
    """
    rules = TARGETS.parse(target).lint_rules()
    copy = model.clone()
    graph.infer_shapes(copy)
    found = [finding for rule in rules for finding in rule(copy)]
    return tuple(sorted(found, key=lambda each: each.severity))
