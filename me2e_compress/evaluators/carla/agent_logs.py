"""What an agent writes: its motion, a line per decision, and a latency trace."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from me2e_compress.errors import EvaluationError
from me2e_compress.registry import drafts
from me2e_compress.runtime.atomic import write_json
from me2e_compress.runtime.latency_trace import LatencyTrace

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
        with drafts.written(path, EvaluationError):
            write_json(path, records)


LINES = "decisions.jsonl"
TRACE = "latency.json"


@dataclass
class DecisionLog:
    """Writes the decisions of one route into an existing folder.

    ``decisions.jsonl`` grows by a line each, so that a worker that is killed loses
    none. ``latency.json`` is a `LatencyTrace` of the measured times without the first,
    which warms up. Files of another run are refused.
    """

    folder: Path
    model_sha256: str
    machine: str
    samples_us: list[int] = field(default_factory=list, init=False)
    _warm: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        """Begin the lines; those of another run are not overwritten."""
        path = self.folder / LINES
        try:
            path.touch(exist_ok=False)
        except OSError as error:
            raise EvaluationError(f"{path}: {error.strerror}") from error

    def note(
        self,
        *,
        frame: int,
        time_s: float,
        wall_s: float,
        measured_us: int,
        latency_us: int,
    ) -> None:
        """Write one decision; the first one is no sample of the trace.

        ``time_s`` is simulated, ``wall_s`` on this machine's clock since the first
        tick: their ratio tells how much slower than the world the machine is, which is
        no latency.
        """
        decision = {
            "frame": frame,
            "time_s": time_s,
            "wall_s": wall_s,
            "measured_us": measured_us,
            "latency_us": latency_us,
        }
        if self._warm:
            self.samples_us.append(measured_us)
        self._warm = True
        with (self.folder / LINES).open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(decision) + "\n")

    def write_trace(self) -> None:
        """Write the trace, if there is a sample."""
        if self.samples_us:
            samples = tuple(self.samples_us)
            trace = LatencyTrace(self.model_sha256, self.machine, samples)
            trace.save(self.folder / TRACE)
