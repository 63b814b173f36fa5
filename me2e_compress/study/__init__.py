"""Studies: compare variants by size, latency, fidelity and driving."""

from me2e_compress.base.listener import Listener
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Timing, Variant, load_study
from me2e_compress.study.run import run_study
from me2e_compress.study.study_result import StudyResult

__all__ = [
    "Condition",
    "Listener",
    "Study",
    "StudyResult",
    "Timing",
    "Variant",
    "load_study",
    "run_study",
]
