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
    from me2e_compress.study.report.page import write_study
    from me2e_compress.workflows.calibrate import (
        CalibrateResult,
        RangesResult,
        calibrate,
        ranges,
    )
    from me2e_compress.workflows.check_model import ModelCheck, check_model
    from me2e_compress.workflows.compare import (
        CompareResult,
        FirstDifferenceResult,
        compare,
        first_difference,
    )
    from me2e_compress.workflows.compare_dump import DumpResult, compare_dump
    from me2e_compress.workflows.compress import CompressResult, compress
    from me2e_compress.workflows.evaluate import (
        EvaluateOptions,
        EvaluateResult,
        evaluate,
    )
    from me2e_compress.workflows.files import (
        EngineResult,
        JoinResult,
        SplitResult,
        build,
        join,
        split,
    )
    from me2e_compress.workflows.frames import record_frames
    from me2e_compress.workflows.inspect import InspectResult, inspect
    from me2e_compress.workflows.lint import LintResult, lint
    from me2e_compress.workflows.options import (
        BuildOptions,
        CalibrateOptions,
        CompareOptions,
        CompressOptions,
        EerOptions,
        FramesOptions,
        GraphOptions,
        InspectOptions,
        LintOptions,
        PlanOptions,
        ProfileOptions,
        SearchOptions,
        SensitivityOptions,
        WriteOptions,
    )
    from me2e_compress.workflows.plan import PlanResult, plan
    from me2e_compress.workflows.profile import ProfileResult, profile
    from me2e_compress.workflows.result import Listener
    from me2e_compress.workflows.score import ScoreResult, score
    from me2e_compress.workflows.search import (
        SearchResult,
        SensitivityResult,
        measure_sensitivity,
        search,
    )

__all__ = [
    "PASSES",
    "BuildOptions",
    "CalibrateOptions",
    "CalibrateResult",
    "CalibrationSet",
    "CompareOptions",
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
    "GraphOptions",
    "InspectOptions",
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
    "WriteOptions",
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

_MODULES = ("errors", "evaluators", "graph", "passes", "registry", "targets", "testing")
"""Packages and modules whose names are public; they load when they are asked for."""

_ROOMS = {
    "calibration.dataset": "CalibrationSet",
    "errors": "Me2eError",
    "graph.modules": "ModuleMap",
    "manager": "PassManager Report Step Verification",
    "passes": "Context PASSES Pass PassResult",
    "study": "StudyResult load_study run_study",
    "study.report.page": "write_study",
    "workflows.calibrate": "CalibrateResult RangesResult calibrate ranges",
    "workflows.check_model": "ModelCheck check_model",
    "workflows.compare": (
        "CompareResult FirstDifferenceResult compare first_difference"
    ),
    "workflows.compare_dump": "DumpResult compare_dump",
    "workflows.compress": "CompressResult compress",
    "workflows.evaluate": "EvaluateOptions EvaluateResult evaluate",
    "workflows.files": "EngineResult JoinResult SplitResult build join split",
    "workflows.frames": "record_frames",
    "workflows.inspect": "InspectResult inspect",
    "workflows.lint": "LintResult lint",
    "workflows.options": (
        "BuildOptions CalibrateOptions CompareOptions CompressOptions "
        "EerOptions FramesOptions GraphOptions InspectOptions LintOptions "
        "PlanOptions ProfileOptions SearchOptions SensitivityOptions "
        "WriteOptions"
    ),
    "workflows.plan": "PlanResult plan",
    "workflows.profile": "ProfileResult profile",
    "workflows.result": "Listener",
    "workflows.score": "ScoreResult score",
    "workflows.search": "SearchResult SensitivityResult measure_sensitivity search",
}
_HOMES = {name: room for room, names in _ROOMS.items() for name in names.split()}


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
