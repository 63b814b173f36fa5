"""``metric_info.json``: the ego's motion, from which Bench2Drive computes comfort."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.atomic import write_json

FILE = "metric_info.json"


@dataclass
class MetricInfo:
    """Keeps an agent's ``metric_info`` complete: one record a tick, at 20 Hz.

    The agents of Bench2DriveZoo write a record whenever they decide; existing records
    are left as they are. An agent whose base class has no ``get_metric_info`` (the
    official leaderboard's) gets none. ``folder`` is used if the agent has no
    ``save_path``.
    """

    agent: Any
    folder: Path
    _own: dict[int, Any] = field(default_factory=dict, init=False)

    @property
    def records(self) -> dict[int, Any]:
        """Records by step: the agent's own dictionary, else one kept for it."""
        found = getattr(self.agent, "metric_info", None)
        return found if isinstance(found, dict) else self._own

    def note(self, frame: int) -> None:
        """Add a record for this tick, unless the agent did.

        ``frame`` is the tick of the route, for an agent that counts no ``step``.
        """
        step = getattr(self.agent, "step", frame)
        if step not in self.records and hasattr(self.agent, "get_metric_info"):
            self.records[step] = self.agent.get_metric_info()

    def write(self) -> None:
        """Write the file, if there is a record."""
        if not self.records:
            return
        # beside the agent's own files, if it writes any
        own = getattr(self.agent, "save_path", None)
        path = (self.folder if own is None else Path(own)) / FILE
        records = {str(step): record for step, record in self.records.items()}
        try:
            write_json(path, records)
        except OSError as error:
            raise EvaluationError(
                f"{path}: cannot be written: {error.strerror}"
            ) from error
