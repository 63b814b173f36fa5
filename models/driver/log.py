"""The log of training: one JSON object a line."""

import json
from pathlib import Path
from typing import Any

from me2e_compress.base.atomic import write_bytes
from models.driver.errors import TrainingError

Row = dict[str, Any]


class Log:
    """A log that stays complete after any interruption, without duplicates.

    Rows have ``what`` (``losses`` or ``closed_loop``) and ``step``, and one row of each
    step and kind.
    """

    def __init__(self, path: Path) -> None:
        """Open a log; the file need not exist.

        Args:
            path: of the ``.jsonl``.
        """
        self.path = path

    def rows(self) -> list[Row]:
        """Return all rows, in order.

        Raises:
            TrainingError: the file is not a log.
        """
        if not self.path.exists():
            return []
        try:
            return [json.loads(line) for line in self.path.read_text().splitlines()]
        except ValueError as error:
            raise TrainingError(f"{self.path}: not a log: {error}") from error

    def add(self, what: str, step: int, row: Row) -> None:
        """Add a row in the place of one of the same kind and step."""
        kept = [
            old for old in self.rows() if (old.get("what"), old["step"]) != (what, step)
        ]
        self._write([*kept, {"what": what, "step": step, **row}])

    def rewind(self, step: int) -> None:
        """Drop the rows after a step: those steps are run again."""
        rows = self.rows()
        kept = [row for row in rows if row["step"] <= step]
        if kept != rows:
            self._write(kept)

    def _write(self, rows: list[Row]) -> None:
        lines = [json.dumps(row, allow_nan=False) + "\n" for row in rows]
        write_bytes(self.path, "".join(lines).encode())
