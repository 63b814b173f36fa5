"""Courses of training: rounds of driving and learning, in full and in small."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from me2e_compress.driving.latency import FixedLatency
from models.driver.data import Sequences
from models.driver.errors import TrainingError
from models.driver.network.config import HighwayConfig
from models.driver.process import Training

HELD_OUT_FIRST, HELD_OUT_EVERY = 7, 16
"""Which of the expert's episodes are held out: one of every other type, where there
are 8 of each."""
SEEDS_APART = 1000
"""Between two seeds of a course, for its stages count from theirs."""


@dataclass(frozen=True)
class Round:
    """Collect, then train on everything collected so far.

    Attributes:
        seed: of the routes that are driven.
        variants: routes of each type.
        expert_share: share of the driving that the expert does; the rest is driven by
            the driver of the round before (DAgger, Ross et al., 2011).
        trainings: stages of training, one after the other.
        scenarios: types of routes; empty for all 44.
        repeat: how often its episodes are among those to learn from.
    """

    seed: int
    variants: int
    expert_share: float
    trainings: tuple[Training, ...]
    scenarios: tuple[str, ...] = ()
    repeat: int = 1


@dataclass(frozen=True)
class Trial:
    """Fresh routes, admitted as those of the benchmark are, and never learned from.

    Attributes:
        seed: of the routes.
        routes: how many, spread evenly over the types.
        scenarios: types of routes; empty for all 44.
    """

    seed: int = 900
    routes: int = 44
    scenarios: tuple[str, ...] = ()


@dataclass(frozen=True)
class Course:
    """All rounds. The first is driven by the expert alone.

    Attributes:
        rounds: in order.
        trial: what the driver drives after every round, for the log.
        config: sizes of the model.

    Raises:
        TrainingError: no driver for a round, a round without training, or a trial on
            routes that are learned from.
    """

    rounds: tuple[Round, ...]
    trial: Trial = field(default_factory=Trial)
    config: HighwayConfig = field(default_factory=HighwayConfig)

    def __post_init__(self) -> None:
        """Check the rounds."""
        if not self.rounds or self.rounds[0].expert_share != 1.0:
            raise TrainingError("course: the expert must drive the first round alone")
        for number, each in enumerate(self.rounds):
            if not each.trainings:
                raise TrainingError(f"course: round {number} has no training")
            if each.seed == self.trial.seed:
                raise TrainingError(
                    f"course: the trial and round {number} share the seed {each.seed}: "
                    "it would drive routes that were learned from"
                )

    def on(self, workers: int) -> Self:
        """Return the course with at most so many processes in training."""
        return self._training(
            lambda each: replace(each, workers=min(workers, each.workers))
        )

    def seeded(self, seed: int) -> Self:
        """Return the course with other random weights and samples; 0 changes nothing.

        The routes are the same: what the expert alone drives has the same bytes.
        """
        return self._training(
            lambda each: replace(each, seed=each.seed + SEEDS_APART * seed)
        )

    def overlooking(self, share: float) -> Self:
        """Return the course whose planner is not told of a share of the agents.

        It then always has occupancy, see `models.driver.step.without_rivals`.

        Raises:
            TrainingError: the share is not between 0 and 1.
        """
        if not 0.0 <= share <= 1.0:
            raise TrainingError(
                f"course: overlooks {share} of the agents; it must be between 0 and 1"
            )

        def change(each: Training) -> Training:
            how = replace(each.augmentation, no_occ=0.0, overlooked=share)
            return replace(each, augmentation=how)

        return self._training(change)

    def _training(self, change: Callable[[Training], Training]) -> Self:
        rounds = tuple(
            replace(each, trainings=tuple(map(change, each.trainings)))
            for each in self.rounds
        )
        return replace(self, rounds=rounds)


def held_out_files(files: Sequence[Path]) -> list[Path]:
    """Return the expert's episodes that are held out, at least one."""
    return list(files[HELD_OUT_FIRST::HELD_OUT_EVERY] or files[:1])


_PLANNER = Training(steps=500, rate=1.2e-3, modules=("planner",))
FULL = Course(
    (
        Round(100, 8, 1.0, (Training(steps=1200),)),
        Round(200, 4, 0.3, (Training(steps=600, rate=8e-4, seed=1), _PLANNER)),
        Round(
            300,
            8,
            0.2,
            (
                Training(steps=1600, rate=8e-4, seed=2),
                replace(_PLANNER, steps=900, seed=3),
            ),
            repeat=2,
        ),
    )
)
"""A direct way to a driver such as the one that ships: some four hours on two cores.

The planner learns alone once the others know more than the expert's routes: what it
reads of them is made anew for every sample, which costs more than its steps."""
FULL_LATENCY = FixedLatency(200_000)
"""Of a decision in its trials: they are for comparing drivers, and four times as many
decisions cost twice the time."""


_FEW = ("ControlLoss", "DynamicObjectCrossing", "HighwayCutIn")
_BRIEF = Training(
    steps=4,
    batch=1,
    workers=2,
    save_every=2,
    check_every=2,
    check_count=2,
    sequences=Sequences(length=2),
)
_AGAIN = replace(_BRIEF, steps=2, seed=1)
_BRIEF_PLANNER = replace(_BRIEF, steps=2, seed=2, modules=("planner",))
SMALL = Course(
    (
        Round(100, 1, 1.0, (_BRIEF,), _FEW),
        Round(200, 1, 0.8, (_AGAIN, _BRIEF_PLANNER), _FEW[2:], repeat=2),
    ),
    Trial(routes=2, scenarios=_FEW[:2]),
    HighwayConfig(stages=(8, 8, 16, 16), anchors=16),
)
"""A minute on two cores. A driver that has learned nothing stands or creeps until the
route times out, after 60 to 200 s: so the expert drives most of the second round."""
SMALL_LATENCY = FixedLatency(1_000_000)
"""Of a decision in its trials, for the same reason: 200 decisions are enough."""
