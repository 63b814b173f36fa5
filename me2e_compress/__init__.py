"""Compress modular end-to-end driving models and measure what it costs on the road.

The functions are what the commands do, silently: ``compress``, ``compare``,
``evaluate`` and so on take files, then options, and return a result.
"""

import importlib
import os
from typing import TYPE_CHECKING

from me2e_compress.base.extras import with_install_hint
from me2e_compress.version import __version__ as __version__

# onnxruntime (1.31), as soon as it is loaded, would write a device id and a database
# into the user's home and look its vendor's host up: its own function comes too late.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:  # what a type checker sees; at run time names load when asked for
    from me2e_compress import graph as graph
    from me2e_compress.base.errors import Me2eError as Me2eError
    from me2e_compress.base.listener import Listener as Listener
    from me2e_compress.calibration.dataset import CalibrationSet as CalibrationSet
    from me2e_compress.commands.calibrate import calibrate as calibrate
    from me2e_compress.commands.compare import compare as compare
    from me2e_compress.commands.compare import first_difference as first_difference
    from me2e_compress.commands.compare_dump import compare_dump as compare_dump
    from me2e_compress.commands.compress import compress as compress
    from me2e_compress.commands.evaluate import check_model as check_model
    from me2e_compress.commands.evaluate import evaluate as evaluate
    from me2e_compress.commands.files import join as join
    from me2e_compress.commands.files import split as split
    from me2e_compress.commands.frames import record_frames as record_frames
    from me2e_compress.commands.inspect import inspect as inspect
    from me2e_compress.commands.lint import lint as lint
    from me2e_compress.commands.options import CalibrateOptions as CalibrateOptions
    from me2e_compress.commands.options import CompareOptions as CompareOptions
    from me2e_compress.commands.options import CompressOptions as CompressOptions
    from me2e_compress.commands.options import EvaluateOptions as EvaluateOptions
    from me2e_compress.commands.options import FramesOptions as FramesOptions
    from me2e_compress.commands.options import GraphOptions as GraphOptions
    from me2e_compress.commands.options import InspectOptions as InspectOptions
    from me2e_compress.commands.options import LintOptions as LintOptions
    from me2e_compress.commands.options import PlanOptions as PlanOptions
    from me2e_compress.commands.options import ProfileOptions as ProfileOptions
    from me2e_compress.commands.options import SearchOptions as SearchOptions
    from me2e_compress.commands.options import SensitivityOptions as SensitivityOptions
    from me2e_compress.commands.options import WriteOptions as WriteOptions
    from me2e_compress.commands.plan import plan as plan
    from me2e_compress.commands.profile import profile as profile
    from me2e_compress.commands.score import score as score
    from me2e_compress.commands.search import measure_sensitivity as measure_sensitivity
    from me2e_compress.commands.search import search as search
    from me2e_compress.graph.modules.module_map import ModuleMap as ModuleMap
    from me2e_compress.manager import PassManager as PassManager
    from me2e_compress.manager import Report as Report
    from me2e_compress.passes import PASSES as PASSES
    from me2e_compress.passes import Context as Context
    from me2e_compress.passes import Pass as Pass
    from me2e_compress.passes import PassResult as PassResult
    from me2e_compress.study import load_study as load_study
    from me2e_compress.study import run_study as run_study
    from me2e_compress.study.report.page import write_study as write_study

_MODULES = ("base", "evaluators", "graph", "passes", "targets", "testing")
"""Packages and modules whose names are public; they load when they are asked for."""

_ROOMS = {
    "calibration.dataset": "CalibrationSet",
    "base.errors": "Me2eError",
    "graph.modules.module_map": "ModuleMap",
    "manager": "PassManager Report",
    "passes": "Context PASSES Pass PassResult",
    "study": "load_study run_study",
    "study.report.page": "write_study",
    "commands.calibrate": "calibrate",
    "commands.compare": "compare first_difference",
    "commands.compare_dump": "compare_dump",
    "commands.compress": "compress",
    "commands.evaluate": "check_model evaluate",
    "commands.files": "join split",
    "commands.frames": "record_frames",
    "commands.inspect": "inspect",
    "commands.lint": "lint",
    "commands.options": (
        "CalibrateOptions CompareOptions CompressOptions "
        "EvaluateOptions FramesOptions GraphOptions InspectOptions LintOptions "
        "PlanOptions ProfileOptions SearchOptions SensitivityOptions WriteOptions"
    ),
    "commands.plan": "plan",
    "commands.profile": "profile",
    "base.listener": "Listener",
    "commands.score": "score",
    "commands.search": "measure_sensitivity search",
}
_HOMES = {name: room for room, names in _ROOMS.items() for name in names.split()}


if not TYPE_CHECKING:  # else every name would be one for a type checker
    __all__ = sorted([*_HOMES, "__version__", "graph"])

    def __getattr__(name: str) -> object:
        """Import a public name on first use: a worker loads only what it uses."""
        if name in _MODULES:
            return importlib.import_module(f"me2e_compress.{name}")
        if name in _HOMES:
            try:
                home = importlib.import_module(f"me2e_compress.{_HOMES[name]}")
            except ImportError as error:
                if (hint := with_install_hint(error)) is error:
                    raise
                raise hint from error
            return getattr(home, name)
        raise AttributeError(f"me2e_compress has no {name}")


def __dir__() -> list[str]:
    """List the public names and those already loaded, for completion."""
    dunders = (name for name in globals() if name.startswith("__"))
    return sorted({*_HOMES, *_MODULES, *dunders})
