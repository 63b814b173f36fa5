"""The compression passes; a new pass is a file here and a row in ``PASSES``."""

from me2e_compress.base.errors import RecipeError
from me2e_compress.base.registry import Registry
from me2e_compress.passes.base import Context, Pass, PassResult

__all__ = ["PASSES", "Context", "Pass", "PassResult"]

_HERE = "me2e_compress.passes"

PASSES: Registry[Pass] = Registry(
    "pass",
    _HERE,
    RecipeError,
    {
        "import-normalize": f"{_HERE}.import_normalize:ImportNormalize",
        "fix-shapes": f"{_HERE}.fix_shapes:FixShapes",
        "freeze-inputs": f"{_HERE}.freeze_inputs:FreezeInputs",
        "fold-constants": f"{_HERE}.fold_constants:FoldConstants",
        "fold-with-onnxsim": f"{_HERE}.fold_with_onnxsim:FoldWithOnnxsim",
        "eliminate-redundant": f"{_HERE}.eliminate_redundant:EliminateRedundant",
        "hoist-linear": f"{_HERE}.hoist_linear:HoistLinear",
        "flatten-matmul": f"{_HERE}.flatten_matmul:FlattenMatmul",
        "ablate-modules": f"{_HERE}.ablate_modules:AblateModules",
        "fuse-operators": f"{_HERE}.fuse_operators:FuseOperators",
        "fuse-basic": f"{_HERE}.fuse_basic:FuseBasic",
        "expand-operators": f"{_HERE}.fused_nodes:ExpandOperators",
        "translate-plugins": f"{_HERE}.fused_nodes:TranslatePlugins",
        "attach-bodies": f"{_HERE}.attach_bodies:AttachBodies",
        "fuse-kernels": f"{_HERE}.fuse_kernels:FuseKernels",
        "quantize-int8": f"{_HERE}.quantize_int8:QuantizeInt8",
        "convert-float16": f"{_HERE}.convert_float16:ConvertFloat16",
        "convert-float32": f"{_HERE}.convert_float32:ConvertFloat32",
        "lower-int8": f"{_HERE}.lower_int8:LowerInt8",
    },
)
