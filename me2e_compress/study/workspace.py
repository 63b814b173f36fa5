"""Folder layout of a study, which lets it resume after a kill."""

from dataclasses import dataclass
from pathlib import Path

from me2e_compress.base import atomic
from me2e_compress.base.errors import StudyError
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Variant

# Files of the results for programs, repositories and browsers
JSON, MARKDOWN, HTML = "study.json", "tables.md", "report.html"


@dataclass(frozen=True)
class Workspace:
    """A folder; studies that share it share compressed models, traces and drives."""

    folder: Path

    @staticmethod
    def drive(variant: Variant, condition: Condition) -> str:
        """Return the base name of the files of one variant under one condition."""
        return f"{variant.name}.{condition.name}"

    def results(self, variant: Variant, condition: Condition) -> Path:
        """Return the results folder of one variant under one condition."""
        return self._made("results") / self.drive(variant, condition)

    def record(self, variant: Variant, condition: Condition) -> Path:
        """Return the path of a finished drive, kept without its frames."""
        return self.folder / "records" / f"{self.drive(variant, condition)}.jsonl"

    def model(self, variant: Variant, key: str) -> Path:
        """Return the path of a compressed model; ``key`` is the hash of its recipe."""
        return self._made("models") / f"{variant.name}.{key[:16]}.onnx"

    def trace(self, variant: Variant, key: str) -> Path:
        """Return the path of a model's latency trace; ``key`` is that of its set."""
        return self._made("traces") / f"{variant.name}.{key[:16]}.json"

    def _made(self, name: str) -> Path:
        path = self.folder / name
        with atomic.writing_errors(path, StudyError):
            path.mkdir(parents=True, exist_ok=True)
        return path
