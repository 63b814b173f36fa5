"""``metric_info.json``: how the ego moved, which Bench2Drive's comfort is made of."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.atomic import write_json

FILE = "metric_info.json"


@dataclass
class MetricInfo:
    """Keeps an agent's ``metric_info`` complete: one record a tick, at 20 Hz.

    The agents of Bench2DriveZoo write a record wherever they decide; one that is there
    is left as it is. An agent whose base class has no ``get_metric_info`` (the official
    leaderboard's) has none.

    Args:
        agent: Whose ego moves.
        folder: Of the route, where the agent has no ``save_path`` of its own.
    """

    agent: Any
    folder: Path
    _own: dict[int, Any] = field(default_factory=dict, init=False)

    @property
    def records(self) -> dict[int, Any]:
        """By step: the agent's own dictionary, else one kept for it."""
        found = getattr(self.agent, "metric_info", None)
        return found if isinstance(found, dict) else self._own

    def note(self, frame: int) -> None:
        """Add this tick, unless the agent did.

        Args:
            frame: Tick of the route, for an agent that counts no ``step``.
        """
        step = getattr(self.agent, "step", frame)
        if step not in self.records and hasattr(self.agent, "get_metric_info"):
            self.records[step] = self.agent.get_metric_info()

    def write(self) -> None:
        """Write the file, where there is a record.

        Raises:
            EvaluationError: It cannot be written.
        """
        if not self.records:
            return
        own = getattr(self.agent, "save_path", None)
        path = (self.folder if own is None else Path(own)) / FILE
        records = {str(step): record for step, record in self.records.items()}
        try:
            write_json(path, records)
        except OSError as error:
            raise EvaluationError(
                f"{path}: cannot be written: {error.strerror}"
            ) from error
