"""Checks that authors of extensions can run in their own tests."""

from me2e_compress.testing.check_evaluator import check_evaluator
from me2e_compress.testing.check_operator import DrawnCall, check_operator
from me2e_compress.testing.check_pass import check_pass
from me2e_compress.testing.check_policy import check_policy
from me2e_compress.testing.form import check_form

__all__ = [
    "DrawnCall",
    "check_evaluator",
    "check_form",
    "check_operator",
    "check_pass",
    "check_policy",
]
