"""The paper's findings as questions, read from a file that is older than the drives."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

from pydantic import ConfigDict, TypeAdapter, with_config

from me2e_compress.base import documents
from me2e_compress.base.errors import StudyError
from me2e_compress.study.cells import MINUS, number
from me2e_compress.study.definition import check_unique

SHIPPED = Path(__file__).parent / "questions.toml"
FILE = "questions.toml"
"""Copy beside the records: the questions as they were before the first drive."""

_STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="forbid")

BEFORE = "before its drives"
PAt = Callable[[float], float]
"""Two-sided p-value of an edge."""


@with_config(_STRICT)
@dataclass(frozen=True)
class PaperQuestion:
    """A question about a finding of the paper, whose answer is yes.

    Attributes:
        paper: What the paper found, in words.
        figures: The paper's own numbers, in the unit of the test.
        of: A drive, ``VARIANT.CONDITION``.
        minus: The drive that is subtracted from it.
        bend: Instead of both: three drives; how much more changes from the first to the
            second than from there to the third.
        column: What is compared.
        holds: On which side of the edge the difference lies if the answer is yes;
            ``within`` is no farther than it from zero.
        turned: Beyond this on the other side, the direction is the other; None is edge.
        tail: The slowest decision of ``of`` takes at least so many times its median.
        untested: Why there is no test.
        seen: What of it was asked after the drives that are kept here had been seen.
    """

    name: str
    asks: str
    paper: str
    figures: tuple[float, ...] = ()
    of: str = ""
    minus: str = ""
    bend: tuple[str, str, str] | None = None
    column: Literal[
        "DS", "room", "DE", "DE b2d", "DC", "DC b2d", "static", "EER_AV", "ms", "times"
    ] = "DS"
    holds: Literal["above", "below", "within"] = "above"
    edge: float = 0.0
    turned: float | None = None
    tail: float | None = None
    untested: str = ""
    seen: str = ""

    def __post_init__(self) -> None:
        tests = bool(self.of and self.minus), self.bend is not None, bool(self.untested)
        unclear = any("." not in each for each in self.drives)
        if sum(tests) != 1 or bool(self.of) != bool(self.minus) or unclear:
            raise StudyError(
                f"question {self.name}: give of and minus, bend, or why it is untested;"
                " a drive is VARIANT.CONDITION"
            )

    @property
    def drives(self) -> tuple[str, ...]:
        """The drives that answer it."""
        return self.bend or tuple(filter(None, (self.of, self.minus)))

    @property
    def compared(self) -> tuple[str, ...]:
        """What is compared, whatever is claimed of it."""
        return self.column, *self.drives

    @property
    def test(self) -> str:
        """The test in words."""
        if self.untested:
            return "none"
        edge = number(self.edge, "g")
        claim = f"within ±{edge}" if self.holds == "within" else f"{self.holds} {edge}"
        if self.bend is not None:
            a, b, c = self.bend
            return (
                f"{self.column}: ({b} {MINUS} {a}) {MINUS} ({c} {MINUS} {b}), {claim}"
            )
        sign = "÷" if self.column == "times" else MINUS
        return f"{self.column}: {self.of} {sign} {self.minus}, {claim}"

    def judge(self, value: float, p_at: PAt, shift: float = 0.0) -> tuple[int, float]:
        """Return which side the value is on, and the p-value that it is.

        1 is the side of the answer yes, -1 the other, 0 neither. ``shift`` moves the
        edges away from the value, since so much hangs on something else.
        """
        if self.holds == "within":
            edge = self.edge - shift
            if abs(value) <= edge:
                return 1, max(p_at(-edge), p_at(edge))
            edge = self.edge + shift
            outside = abs(value) > edge
            return -outside, p_at(edge if value > 0.0 else -edge) if outside else 1.0
        up = 1.0 if self.holds == "above" else -1.0
        edge = self.edge + up * shift
        if up * (value - edge) > 0.0:
            return 1, p_at(edge)
        turned = (self.edge if self.turned is None else self.turned) - up * shift
        if up * (value - turned) < 0.0:
            return -1, p_at(turned)
        return 0, 1.0


@with_config(_STRICT)
@dataclass(frozen=True)
class PaperQuestions:
    """A file of questions, and how all of them are decided.

    Attributes:
        step: Points of driving score that one frame of delay more costs.
        name: Of the file.
        sha256: Digest of the file.
    """

    interval: Literal["types"]
    correction: Literal["holm"]
    alpha: float
    step: float
    question: tuple[PaperQuestion, ...]
    name: str = ""
    sha256: str = ""

    def __post_init__(self) -> None:
        check_unique("question", [each.name for each in self.question])
        if not (0.0 < self.alpha < 1.0 and self.step >= 0.0):
            raise StudyError(
                f"alpha {self.alpha:g} and step {self.step:g}: alpha lies between 0 and"
                " 1, and a step is not negative"
            )

    @classmethod
    def load(cls, path: Path | None = None) -> "PaperQuestions":
        """Read a file, or those that ship.

        Raises:
            StudyError: It is missing or malformed, a key is unknown, or a question has
                no test.
        """
        path = path or SHIPPED
        with documents.reading(path, StudyError, "not questions"):
            content = documents.read_bytes(path)
            found = documents.from_toml(content)
            found["name"] = path.name
            found["sha256"] = hashlib.sha256(content).hexdigest()
            try:
                # JSON has lists for tuples, but no dates
                return _QUESTIONS.validate_json(json.dumps(found, default=str))
            except StudyError as error:
                raise documents.MalformedError(str(error)) from error

    def since(self, question: PaperQuestion, now: Self) -> str:
        """Say how a question that is asked now stood in these, the earlier ones."""
        before = next((e for e in self.question if e.name == question.name), None)
        if before is None:
            return "added after seeing results"
        then, rules = (
            (each.interval, each.correction, each.alpha, each.step)
            for each in (self, now)
        )
        same = then == rules and replace(before, seen=question.seen) == question
        return BEFORE if same else "changed after its drives"


_QUESTIONS = TypeAdapter(PaperQuestions)
