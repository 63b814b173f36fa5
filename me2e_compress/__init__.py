"""Compress modular end-to-end driving models and measure what it costs on the road.

The functions are what the commands do, silently: ``compress``, ``compare``,
``evaluate`` and so on take files, then options, and return a result.
"""

import importlib
import os
from typing import TYPE_CHECKING

from me2e_compress.extras import explained
from me2e_compress.version import __version__

# onnxruntime (1.31), as soon as it is loaded, would write a device id and a database
# into the user's home and look its vendor's host up: its own function comes too late.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from me2e_compress import graph
    from me2e_compress.calibration.dataset import CalibrationSet
    from me2e_compress.errors import Me2eError
    from me2e_compress.graph.modules import ModuleMap
    from me2e_compress.manager import PassManager, Report, Step, Verification
    from me2e_compress.passes import PASSES, Context, Pass, PassResult
    from me2e_compress.study import StudyResult, load_study, run_study
    from me2e_compress.study.write import write_study
    from me2e_compress.workflows.build import BuildOptions, EngineResult, build
    from me2e_compress.workflows.calibrate import calibrate
    from me2e_compress.workflows.calibrate_options import CalibrateOptions
    from me2e_compress.workflows.calibrate_result import CalibrateResult
    from me2e_compress.workflows.check_model import ModelCheck, check_model
    from me2e_compress.workflows.compare import CompareResult, compare
    from me2e_compress.workflows.compare_dump import DumpResult, compare_dump
    from me2e_compress.workflows.compress import CompressOptions, compress
    from me2e_compress.workflows.compress_result import CompressResult
    from me2e_compress.workflows.evaluate import (
        EvaluateOptions,
        EvaluateResult,
        evaluate,
    )
    from me2e_compress.workflows.first_difference import (
        FirstDifferenceResult,
        first_difference,
    )
    from me2e_compress.workflows.frames import FramesOptions, record_frames
    from me2e_compress.workflows.inspect import inspect
    from me2e_compress.workflows.inspect_result import InspectResult
    from me2e_compress.workflows.join import JoinResult, join
    from me2e_compress.workflows.lint import LintOptions, LintResult, lint
    from me2e_compress.workflows.listener import Listener
    from me2e_compress.workflows.plan import PlanOptions, PlanResult, plan
    from me2e_compress.workflows.profile import ProfileOptions, profile
    from me2e_compress.workflows.profile_result import ProfileResult
    from me2e_compress.workflows.ranges import RangesResult, ranges
    from me2e_compress.workflows.score import ScoreResult, score
    from me2e_compress.workflows.score_eer import EerOptions
    from me2e_compress.workflows.search import SearchOptions, SearchResult, search
    from me2e_compress.workflows.sensitivity import (
        SensitivityOptions,
        SensitivityResult,
        measure_sensitivity,
    )
    from me2e_compress.workflows.split import SplitResult, split

__all__ = [
    "PASSES",
    "BuildOptions",
    "CalibrateOptions",
    "CalibrateResult",
    "CalibrationSet",
    "CompareResult",
    "CompressOptions",
    "CompressResult",
    "Context",
    "DumpResult",
    "EerOptions",
    "EngineResult",
    "EvaluateOptions",
    "EvaluateResult",
    "FirstDifferenceResult",
    "FramesOptions",
    "InspectResult",
    "JoinResult",
    "LintOptions",
    "LintResult",
    "Listener",
    "Me2eError",
    "ModelCheck",
    "ModuleMap",
    "Pass",
    "PassManager",
    "PassResult",
    "PlanOptions",
    "PlanResult",
    "ProfileOptions",
    "ProfileResult",
    "RangesResult",
    "Report",
    "ScoreResult",
    "SearchOptions",
    "SearchResult",
    "SensitivityOptions",
    "SensitivityResult",
    "SplitResult",
    "Step",
    "StudyResult",
    "Verification",
    "__version__",
    "build",
    "calibrate",
    "check_model",
    "compare",
    "compare_dump",
    "compress",
    "evaluate",
    "first_difference",
    "graph",
    "inspect",
    "join",
    "lint",
    "load_study",
    "measure_sensitivity",
    "plan",
    "profile",
    "ranges",
    "record_frames",
    "run_study",
    "score",
    "search",
    "split",
    "write_study",
]

_MODULES = (
    "errors",
    "evaluators",
    "graph",
    "passes",
    "registry",
    "targets",
    "testing",
)
"""Packages and modules whose names are public; they load when they are asked for."""

_ROOMS = {
    "calibration.dataset": ("CalibrationSet",),
    "errors": ("Me2eError",),
    "manager": ("PassManager", "Report", "Step", "Verification"),
    "graph.modules": ("ModuleMap",),
    "passes": ("PASSES", "Context", "Pass", "PassResult"),
    "study": ("StudyResult", "load_study", "run_study"),
    "study.write": ("write_study",),
    "workflows.build": ("BuildOptions", "EngineResult", "build"),
    "workflows.calibrate": ("calibrate",),
    "workflows.calibrate_options": ("CalibrateOptions",),
    "workflows.calibrate_result": ("CalibrateResult",),
    "workflows.check_model": ("ModelCheck", "check_model"),
    "workflows.compare": ("CompareResult", "compare"),
    "workflows.compare_dump": ("DumpResult", "compare_dump"),
    "workflows.compress": ("CompressOptions", "compress"),
    "workflows.compress_result": ("CompressResult",),
    "workflows.evaluate": ("EvaluateOptions", "EvaluateResult", "evaluate"),
    "workflows.first_difference": ("FirstDifferenceResult", "first_difference"),
    "workflows.frames": ("FramesOptions", "record_frames"),
    "workflows.inspect": ("inspect",),
    "workflows.inspect_result": ("InspectResult",),
    "workflows.join": ("JoinResult", "join"),
    "workflows.lint": ("LintOptions", "LintResult", "lint"),
    "workflows.listener": ("Listener",),
    "workflows.plan": ("PlanOptions", "PlanResult", "plan"),
    "workflows.profile": ("ProfileOptions", "profile"),
    "workflows.profile_result": ("ProfileResult",),
    "workflows.ranges": ("RangesResult", "ranges"),
    "workflows.score": ("ScoreResult", "score"),
    "workflows.score_eer": ("EerOptions",),
    "workflows.search": ("SearchOptions", "SearchResult", "search"),
    "workflows.sensitivity": (
        "SensitivityOptions",
        "SensitivityResult",
        "measure_sensitivity",
    ),
    "workflows.split": ("SplitResult", "split"),
}
_HOMES = {name: room for room, names in _ROOMS.items() for name in names}


if not TYPE_CHECKING:  # else every name would be one for a type checker

    def __getattr__(name: str) -> object:
        """Load a public name when it is asked for: a worker pays for what it uses."""
        if name in _MODULES:
            return importlib.import_module(f"me2e_compress.{name}")
        if name in _HOMES:
            try:
                home = importlib.import_module(f"me2e_compress.{_HOMES[name]}")
            except ImportError as error:
                if (told := explained(error)) is error:
                    raise
                raise told from error
            return getattr(home, name)
        raise AttributeError(f"me2e_compress has no {name}")


def __dir__() -> list[str]:
    """List the public names and what is loaded, for completion."""
    dunders = (name for name in globals() if name.startswith("__"))
    return sorted({*__all__, *_MODULES, *dunders})
