"""Compress modular end-to-end driving models and measure what it costs on the road."""

from me2e_compress import graph, recipe
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import Me2eError
from me2e_compress.manager import PassManager, Report, Step, Verification
from me2e_compress.modules import ModuleMap
from me2e_compress.passes import PASSES, Context, Pass, PassResult

__version__ = "0.1.0"
__all__ = [
    "PASSES",
    "CalibrationSet",
    "Context",
    "Me2eError",
    "ModuleMap",
    "Pass",
    "PassManager",
    "PassResult",
    "Report",
    "Step",
    "Verification",
    "graph",
    "recipe",
]
