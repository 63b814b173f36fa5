"""The result of an evaluation, as it is shown."""

import dataclasses
from pathlib import Path

from me2e_compress.metrics.deadlines import Deadlines
from me2e_compress.metrics.scores import Scores
from me2e_compress.workflows.deadlines_table import deadlines_table
from me2e_compress.workflows.result import Result, Table
from me2e_compress.workflows.score import driving_score, score_records, scores_table


@dataclasses.dataclass(frozen=True, repr=False)
class EvaluateResult(Result):
    """How a policy drives.

    Attributes:
        policy: the policy as named, or the evaluator where that drives none.
        late: latencies charged to decisions, against the frame time; None if none were.
    """

    policy: str
    output: Path
    scores: Scores
    pictures: tuple[Path, ...] = ()
    late: Deadlines | None = None

    @property
    def headline(self) -> str:
        """The policy, its driving score and the routes."""
        return f"{self.policy}: {driving_score(self.scores)}"

    def lines(self) -> tuple[str, ...]:
        """Return no line: the table says everything."""
        return ()

    def alerts(self) -> tuple[str, ...]:
        """Return the routes that ended by a failure."""
        return tuple(filter(None, [self.scores.failed]))

    def tables(self) -> tuple[Table, ...]:
        """Return every score with its interval, and the latencies charged."""
        late = None if self.late is None else deadlines_table(self.policy, self.late)
        scores = scores_table(self.policy, self.scores)
        return (scores,) if late is None else (scores, late)

    def records(self) -> list[dict[str, object]]:
        """Return one row per score."""
        return score_records(self.scores)

    def to_json(self) -> object:
        """Return the scores, and the latencies charged to decisions."""
        late = None if self.late is None else self.late.to_json()
        return {**self.scores.to_json(), "deadlines": late}
