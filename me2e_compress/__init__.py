"""Compress modular end-to-end driving models and measure what it costs on the road."""

import importlib
from typing import TYPE_CHECKING

from me2e_compress.version import __version__

if TYPE_CHECKING:
    from me2e_compress import graph, recipe
    from me2e_compress.calibration.dataset import CalibrationSet
    from me2e_compress.errors import Me2eError
    from me2e_compress.manager import PassManager, Report, Step, Verification
    from me2e_compress.modules import ModuleMap
    from me2e_compress.passes import PASSES, Context, Pass, PassResult

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
    "__version__",
    "graph",
    "recipe",
]

_ROOMS = {
    "CalibrationSet": "calibration.dataset",
    "Me2eError": "errors",
    "ModuleMap": "modules",
    **dict.fromkeys(("PassManager", "Report", "Step", "Verification"), "manager"),
    **dict.fromkeys(("PASSES", "Context", "Pass", "PassResult"), "passes"),
}


def __getattr__(name: str) -> object:
    """Load a public name when it is asked for: a worker pays only for what it uses."""
    if name in ("graph", "recipe"):
        return importlib.import_module(f"me2e_compress.{name}")
    if name in _ROOMS:
        return getattr(importlib.import_module(f"me2e_compress.{_ROOMS[name]}"), name)
    raise AttributeError(f"me2e_compress has no {name}")
