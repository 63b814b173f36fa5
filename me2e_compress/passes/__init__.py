"""The passes. To add one: write its file, then add its class to this table."""

from me2e_compress.passes.base import Context, Pass, PassResult

PASSES: dict[str, type[Pass]] = {}

__all__ = ["PASSES", "Context", "Pass", "PassResult"]
