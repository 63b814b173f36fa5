"""A condition of a study: latency of decisions, world step, weather."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from me2e_compress.display import counted
from me2e_compress.driving.latency import (
    LATENCY_SOURCES,
    LatencySource,
    LimitedLatency,
    with_draws,
)
from me2e_compress.errors import EvaluationError, StudyError
from me2e_compress.evaluators.highway.conditions import ConditionOptions, Conditions
from me2e_compress.registry import name_in
from me2e_compress.study.study_blocks import check_name

TRACE = "trace"
"""The latency of each model's own trace, times the device scale."""


@dataclass(frozen=True)
class Condition(ConditionOptions):
    """The conditions that a variant drives under.

    Args:
        name: Follows the rules of a variant's name.
        latency: Latency of decisions, as for ``evaluate``: ``none``, ``fps:F``, or
            ``trace``, each model's own latencies, also within another source:
            ``agents{source=trace, per_agent_us=3000}``.
        mean_of: Instead of a latency: every decision takes the mean of this drive,
            ``VARIANT.CONDITION``, whose condition comes earlier.
        in_order: Replay a trace in its order, which keeps bursts.
        limit_fps: Frame limiter: a decision takes at least one period.
        seed: Seed of draws from traces; None takes the study's.
        against: Another condition that differs from this one in one thing: drives are
            compared with those under it, route by route.

    Raises:
        StudyError: The name is invalid, or options do not go together.
        EvaluationError: An option is one that `evaluate` refuses, too.
    """

    name: str
    latency: str = ""
    mean_of: str = ""
    in_order: bool = False
    limit_fps: float | None = None
    seed: int | None = None
    against: str = ""

    def __post_init__(self) -> None:
        check_name("condition", self.name)
        if bool(self.latency) == bool(self.mean_of):
            raise StudyError(f"condition {self.name}: give a latency or mean_of")
        if self.mean_of and (self.in_order or self.limit_fps is not None):
            raise StudyError(
                f"condition {self.name}: a mean has no order and takes no limit"
            )
        try:
            source = None if self.mean_of else self.source(0)
            self.settings  # noqa: B018
        except EvaluationError as error:
            raise EvaluationError(f"condition {self.name}: {error}") from error
        if source is not None and source.measures:
            raise StudyError(self._refusal())

    def source(self, seed: int) -> LatencySource:
        """Return the latency source; one that lacks its trace waits for a model's.

        ``seed`` applies if the condition has none of its own. A trace file is an error:
        it belongs to a variant.
        """
        own = seed if self.seed is None else self.seed
        return with_draws(self._parsed, in_order=self.in_order, seed=own)

    @functools.cached_property
    def _parsed(self) -> LatencySource:
        if self._names_a_file:
            raise StudyError(self._refusal())
        source = LATENCY_SOURCES.parse(self.latency)
        if self.limit_fps is None:
            return source
        return LimitedLatency(source, self.limit_fps)

    @property
    def traced(self) -> bool:
        """Whether each model is charged its own measured latencies."""
        return not self.mean_of and self._parsed.lacks_trace

    @property
    def mean_cell(self) -> tuple[str, str]:
        """Variant and condition of the drive whose mean is charged."""
        variant, _, condition = self.mean_of.partition(".")
        return variant, condition

    def drives(self, latency: LatencySource, image_size: tuple[int, int]) -> Conditions:
        """Return the conditions of a drive; ``image_size`` is rows and columns."""
        return replace(self.settings, latency=latency, image_size=image_size)

    def described(self, device: str) -> str:
        """Describe it for the head of a table; ``device`` is that of the traces."""
        return ", ".join([f"{self.name}: {self._cost(device)}", *self._changes()])

    def to_json(self) -> dict[str, Any]:
        """Return every option; ``charged`` is the latency, None for a mean."""
        return {
            "name": self.name,
            "charged": self.latency or None,
            "mean_of": self.mean_of or None,
            "latency_model": self.latency_model,
            "in_order": self.in_order,
            "limit_fps": self.limit_fps,
            "seed": self.seed,
            "dt_ms": self.dt_ms,
            "weather": self.weather,
            "against": self.against or None,
        } | ({"drive_on": True} if self.drive_on else {})

    @property
    def _names_a_file(self) -> bool:
        if self.latency.startswith(TRACE) and name_in(self.latency) != TRACE:
            return True
        return "trace:" in self.latency or "trace=" in self.latency

    def _refusal(self) -> str:
        return (
            f"condition {self.name}: latency {self.latency!r}: a study knows none, "
            f"fps:F and {TRACE}, and what is made of them (a file is a variant's: "
            "trace = FILE)"
        )

    def _cost(self, device: str) -> str:
        if self.mean_of:
            return f"every decision costs the mean of {self.mean_of}"
        if self.latency == "none":
            return "decisions cost no time"
        if self.latency == TRACE:
            return f"each model's own latency, {device}"
        if name_in(self.latency) == "fps" and ":" in self.latency:
            return _per_second(float(self.latency.removeprefix("fps:")))
        return f"{self.latency}, {device}" if self.traced else self.latency

    def _changes(self) -> list[str]:
        said = {
            "in the trace's order": self.in_order,
            f"limited to {_per_second(self.limit_fps or 0)}": self.limit_fps,
            "every control late (fifo)": self.latency_model != "drop",
            f"a step of {self.dt_ms:g} ms": self.dt_ms != 50.0,
            f"weather {self.weather}": self.weather,
            "driving on after collisions": self.drive_on,
        }
        return [words for words, true in said.items() if true]


def _per_second(fps: float) -> str:
    return f"{counted(fps, 'decision')} a second"


def check_conditions(conditions: Sequence[Condition], variants: Sequence[str]) -> None:
    """Check that means refer to earlier drives, and ``against`` to conditions."""
    before = list[str]()
    names = [each.name for each in conditions]
    for each in conditions:
        variant, condition = each.mean_cell
        if each.mean_of and (variant not in variants or condition not in before):
            raise StudyError(
                f"condition {each.name}: mean_of {each.mean_of!r} is no"
                " VARIANT.CONDITION of a condition before it"
            )
        if each.against and (each.against not in names or each.against == each.name):
            raise StudyError(
                f"condition {each.name}: against {each.against!r} is not another"
                f" condition; there are {', '.join(names)}"
            )
        before.append(each.name)


def check_conditions_elsewhere(evaluator: str, conditions: Sequence[Condition]) -> None:
    """Refuse conditions that only highway understands."""
    for each in conditions:
        if each != Condition(each.name, "none"):
            raise StudyError(
                f"condition {each.name}: {evaluator} has conditions of its own, in its "
                'options: only latency = "none" goes with it'
            )


def check_pairs(
    pairs: Sequence[tuple[str, str]],
    variants: Sequence[str],
    conditions: Sequence[str],
) -> None:
    """Check that pairs name drives of the study."""
    there = {f"{one}.{other}" for one in variants for other in conditions}
    for name in (name for pair in pairs for name in pair):
        if name not in there:
            raise StudyError(
                f"pair: {name!r} is no VARIANT.CONDITION; there are "
                f"{', '.join(variants)} and {', '.join(conditions)}"
            )
