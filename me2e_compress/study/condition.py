"""A condition of a study: latency of decisions, world step, weather."""

import functools
import re
from dataclasses import dataclass
from typing import Any

from pydantic import ConfigDict, with_config

from me2e_compress.base.errors import EvaluationError, StudyError
from me2e_compress.base.text import name_in
from me2e_compress.driving.latency import LATENCY_SOURCES, LatencySource, with_draws
from me2e_compress.evaluators import Drive

TRACE = "trace"  # the latency of each model's own trace, times the device scale

FORM = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)
# Options of a condition's drive besides its latency
DRIVE_OPTIONS = ("latency_model", "dt_ms", "weather")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]*")


def check_name(kind: str, name: str) -> None:
    """Check that a name can name a folder: it begins with a letter or digit."""
    if _NAME.fullmatch(name) is None:
        raise StudyError(
            f"{kind} {name!r}: a name is made of letters, digits, '_', '+' and '-'"
        )


@with_config(FORM)
@dataclass(frozen=True)
class Condition:
    """The conditions that a variant drives under.

    Raises:
        StudyError: The name is invalid, or options do not go together.
        EvaluationError: An option is one that `evaluate` refuses, too.
    """

    name: str  # follows the rules of a variant's name
    # Latency of decisions, as for `evaluate`: `none`, `fps:F`, or `trace`, each model's
    # own latencies, also with options (`trace{in_order=true, seed=3}`) and within
    # another source (`limited{source=trace, fps=10}`)
    latency: str = ""
    # Instead of a latency: every decision takes the mean of this drive,
    # `VARIANT.CONDITION`, whose condition comes earlier
    mean_of: str = ""
    latency_model: str = "drop"  # as of `evaluate`, and so `dt_ms`, `weather`
    dt_ms: float = 50.0
    weather: str = ""

    def __post_init__(self) -> None:
        check_name("condition", self.name)
        if bool(self.latency) == bool(self.mean_of):
            raise StudyError(f"condition {self.name}: give a latency or mean_of")
        try:
            if self.latency:
                self.source(0)
            self.drive  # noqa: B018
        except EvaluationError as error:
            raise EvaluationError(f"condition {self.name}: {error}") from error

    @functools.cached_property
    def drive(self) -> Drive:
        """The drive without its latency, which is each variant's, and its routes."""
        return Drive.of_words(self.latency_model, self.dt_ms, self.weather)

    def source(self, seed: int) -> LatencySource:
        """Return the latency source, drawn by ``seed`` unless the text has one."""
        return with_draws(self._parsed, seed)

    @functools.cached_property
    def _parsed(self) -> LatencySource:
        # A trace with options is fine, a trace of a file is not
        text = self.latency
        names_a_file = text.startswith(TRACE) and name_in(text) != TRACE
        names_a_file = names_a_file or "trace:" in text or "trace=" in text
        source = None if names_a_file else LATENCY_SOURCES.parse(text)
        if source is None or source.measures:
            raise StudyError(
                f"condition {self.name}: latency {text!r}: a study knows none, "
                f"fps:F and {TRACE}, and what is made of them (a file is a variant's: "
                "trace = FILE)"
            )
        return source

    @property
    def traced(self) -> bool:
        """Whether each model is charged its own measured latencies."""
        return not self.mean_of and self._parsed.lacks_trace

    @property
    def changed(self) -> dict[str, object]:
        """Options of its drive, without the latency, that are not the defaults."""
        options = ((name, getattr(self, name)) for name in DRIVE_OPTIONS)
        return {n: value for n, value in options if value != getattr(Condition, n)}

    def described(self, device: str) -> str:
        """Describe it for the head of a table; ``device`` is that of the traces."""
        latency = self.latency or f"the mean of {self.mean_of}"
        latency += f" of {device}" * self.traced
        words = [f"{name} {option}" for name, option in self.changed.items()]
        return ", ".join([f"{self.name}: latency {latency}", *words])

    def to_json(self) -> dict[str, Any]:
        """Return every option; ``charged`` is the latency, None for a mean."""
        return {
            "name": self.name,
            "charged": self.latency or None,
            "mean_of": self.mean_of or None,
            **{name: getattr(self, name) for name in DRIVE_OPTIONS},
        }
