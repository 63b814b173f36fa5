"""The passes. To add one: write its file, then add its class to this table."""

from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.fuse_basic import FuseBasic
from me2e_compress.passes.import_normalize import ImportNormalize

PASSES: dict[str, type[Pass]] = {
    cls.name: cls
    for cls in (ImportNormalize, FoldConstants, EliminateRedundant, FuseBasic)
}

__all__ = ["PASSES", "Context", "Pass", "PassResult"]
