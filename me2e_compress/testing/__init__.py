"""Checks that anybody's additions can run in their own tests."""

from me2e_compress.testing.check_pass import check_pass

__all__ = ["check_pass"]
