"""The passes. To add one: write its file, then add its class to this table."""

from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.fold_with_onnxsim import FoldWithOnnxsim
from me2e_compress.passes.fuse_basic import FuseBasic
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8

PASSES: dict[str, type[Pass]] = {
    cls.name: cls
    for cls in (
        ImportNormalize,
        FoldConstants,
        FoldWithOnnxsim,
        EliminateRedundant,
        AblateModules,
        FuseBasic,
        QuantizeInt8,
        LowerInt8,
    )
}

__all__ = ["PASSES", "Context", "Pass", "PassResult"]
