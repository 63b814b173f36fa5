"""What the decisions of one route took: a line each, and a latency trace at the end."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.latency_trace import LatencyTrace

LINES = "decisions.jsonl"
TRACE = "latency.json"


@dataclass(frozen=True)
class DecisionRecord:
    """One decision.

    Attributes:
        frame: Tick of the route, from 0.
        time_s: Simulated time, as the leaderboard told it.
        wall_s: Time since the first tick on this machine's clock: beside `time_s` it
            says how much slower than the world the machine is, which is no latency.
        measured_us: What the decision took here.
        latency_us: What it was charged with.
    """

    frame: int
    time_s: float
    wall_s: float
    measured_us: int
    latency_us: int


@dataclass
class DecisionLog:
    """Writes the decisions of one route into a folder.

    ``decisions.jsonl`` grows by a line each, so that a worker that is killed loses
    none. ``latency.json`` is a `LatencyTrace` of what they took here, without the
    first, which warms up.

    Args:
        folder: Of the route; it is there.
        model_sha256: Of the model that decides.
        machine: Where it runs, in words.

    Raises:
        EvaluationError: Another run wrote there, or nothing can be written.
    """

    folder: Path
    model_sha256: str
    machine: str
    samples_us: list[int] = field(default_factory=list, init=False)
    _warm: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        """Begin the lines; those of another run are not written over."""
        path = self.folder / LINES
        try:
            path.touch(exist_ok=False)
        except OSError as error:
            raise EvaluationError(f"{path}: {error.strerror}") from error

    def note(self, decision: DecisionRecord) -> None:
        """Write one decision; the first of them is no sample of the trace."""
        if self._warm:
            self.samples_us.append(decision.measured_us)
        self._warm = True
        with (self.folder / LINES).open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(asdict(decision)) + "\n")

    def write_trace(self) -> None:
        """Write the trace, where there is a sample.

        Raises:
            EvaluationError: It cannot be written.
        """
        if self.samples_us:
            samples = tuple(self.samples_us)
            trace = LatencyTrace(self.model_sha256, self.machine, samples)
            trace.save(self.folder / TRACE)
