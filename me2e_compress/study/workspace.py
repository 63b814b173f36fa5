"""Where a study keeps what it made, so that it goes on after a kill."""

from dataclasses import dataclass
from pathlib import Path

from me2e_compress.errors import StudyError
from me2e_compress.study.definition import Condition, Scheme

JSON, MARKDOWN, HTML = "study.json", "tables.md", "report.html"
"""What is found, for programs, in a repository and in a browser."""


@dataclass(frozen=True)
class Workspace:
    """A folder; studies that share it share compressed models, traces and drives.

    Args:
        folder: It is made when needed.
    """

    folder: Path

    def results(self, scheme: Scheme, condition: Condition) -> Path:
        """Return the folder of results of one scheme under one condition."""
        return self._made("results") / f"{scheme.name}.{condition.name}"

    def model(self, scheme: Scheme, key: str) -> Path:
        """Return where the model goes that passes make: a key is a recipe's hash."""
        return self._made("models") / f"{scheme.name}.{key[:16]}.onnx"

    def trace(self, scheme: Scheme) -> Path:
        """Return where the latencies of a scheme's model go."""
        return self._made("traces") / f"{scheme.name}.json"

    def picture(
        self, scheme: Scheme, condition: Condition, route: str, time_us: int
    ) -> Path:
        """Return where the picture of one moment goes."""
        name = f"{route}.{time_us // 1000}ms.{scheme.name}.{condition.name}.png"
        return self._made("pictures") / name

    def _made(self, name: str) -> Path:
        path = self.folder / name
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StudyError(f"{path}: cannot be made: {error.strerror}") from error
        return path
