"""The whole way from nothing to a driver: collect, train, let it drive, train again."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from me2e_compress.errors import TrainingError
from me2e_compress.graph import sha256_of
from me2e_compress.zoo.highway.config import HighwayConfig
from me2e_compress.zoo.highway.export import write
from me2e_compress.zoo.highway.stack import Highway
from me2e_compress.zoo.train.episodes import Collection, collect
from me2e_compress.zoo.train.loop import Training, train

HELD_OUT_EVERY = 28
"""One episode in so many of the expert's is only looked at."""


@dataclass(frozen=True)
class Round:
    """Collect, then train on everything collected so far.

    Attributes:
        seed: of the routes that are driven.
        variants: routes of each type.
        expert_share: share of the driving that the expert does; less than 1 lets the
            driver of the round before drive (DAgger, Ross et al., 2011).
        training: what is learned then.
        scenarios: types of routes; empty for all 44.
    """

    seed: int
    variants: int
    expert_share: float
    training: Training
    scenarios: tuple[str, ...] = ()


@dataclass(frozen=True)
class Course:
    """All rounds. The first is driven by the expert alone.

    Attributes:
        rounds: in order.
        config: sizes of the model.
    """

    rounds: tuple[Round, ...]
    config: HighwayConfig = field(default_factory=HighwayConfig)

    def __post_init__(self) -> None:
        """Refuse rounds in which nobody could drive."""
        if not self.rounds or self.rounds[0].expert_share != 1.0:
            raise TrainingError("the expert drives alone in the first round")


FULL = Course(
    (
        Round(100, 14, 1.0, Training(steps=1000)),
        Round(200, 4, 0.3, Training(steps=900, rate=8e-4, seed=1)),
        Round(300, 4, 0.15, Training(steps=700, rate=8e-4, seed=2)),
    )
)
"""What trained the driver that ships."""

FEW = ("HighwayCutIn", "VanillaSignalizedTurnEncounterRedLight")
BRIEF = Training(steps=4, batch=1, workers=2, save_every=2, check_every=4)
SMALL = Course(
    (
        Round(100, 1, 1.0, BRIEF, FEW),
        Round(200, 1, 0.5, replace(BRIEF, steps=2, check_every=2, seed=1), FEW),
    ),
)
"""The same way in small: it learns nothing, but every part of it runs."""


@dataclass(frozen=True)
class News:
    """What a course is at.

    Attributes:
        what: in words.
        done: of the present part.
        total: of the present part.
    """

    what: str
    done: int
    total: int


def run(
    course: Course,
    folder: Path,
    workers: int,
    on_news: Callable[[News], None] = lambda news: None,
) -> Path:
    """Go the whole way, or what is left of it after an interruption.

    Args:
        course: the rounds.
        folder: gets a folder a round: ``episodes/``, ``training/``, ``driver.onnx``.
        workers: processes, for driving and for training.
        on_news: told how far it is.

    Returns:
        The last ``driver.onnx``.

    Raises:
        TrainingError: the folder is of another course, or a part failed.
        EvaluationError: episodes of another collection are in the way.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, course, workers)
    learned, held_out = list[Path](), list[Path]()
    start, driver = None, None
    for number, each in enumerate(course.rounds):
        place = folder / f"round-{number}"
        files = _drive(each, course, place, driver, workers, number, on_news)
        if number == 0:
            held_out = files[HELD_OUT_EVERY // 4 :: HELD_OUT_EVERY] or files[:1]
        learned += [file for file in files if file not in held_out]
        on_news(News(f"round {number}: training", 0, each.training.steps))
        training = replace(each.training, workers=min(workers, each.training.workers))
        start = train(
            training, course.config, learned, held_out, start, place / "training"
        )
        driver = place / "driver.onnx"
        write(load(start, course.config), driver)
    if driver is None:
        raise TrainingError("a course without rounds trains nothing")
    return driver


def load(checkpoint: Path, config: HighwayConfig) -> Highway:
    """The driver of a checkpoint: its averaged weights.

    Raises:
        TrainingError: it is no checkpoint of this model.
    """
    model = Highway(config)
    try:
        model.load_state_dict(torch.load(checkpoint, weights_only=True)["mean"])
    except (OSError, KeyError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise TrainingError(f"{checkpoint}: not a checkpoint: {first}") from error
    return model.eval()


def _drive(
    each: Round,
    course: Course,
    place: Path,
    driver: Path | None,
    workers: int,
    number: int,
    on_news: Callable[[News], None],
) -> list[Path]:
    student = None if each.expert_share == 1.0 else driver
    what = Collection(
        each.seed,
        each.variants,
        image_size=course.config.image_size,
        scenarios=each.scenarios,
        expert_share=each.expert_share,
        student=None if student is None else sha256_of(student),
    )
    told = f"round {number}: driving"
    collect(
        place / "episodes",
        what,
        student,
        workers,
        lambda progress: on_news(News(told, progress.done, progress.total)),
    )
    return episodes_in(place / "episodes")


def episodes_in(folder: Path) -> list[Path]:
    """The episodes of a folder, in order, drafts left out."""
    return sorted(
        file for file in folder.glob("*.npz") if not file.name.startswith(".")
    )


def _claim(folder: Path, course: Course, workers: int) -> None:
    """Write down what the folder is, or refuse it."""
    path = folder / "course.json"
    words = json.dumps({"course": repr(course), "workers": workers}, indent=1)
    if not path.exists():
        path.write_text(words)
        return
    if path.read_text() != words:
        raise TrainingError(
            f"{folder}: another course was begun here, or with other workers: take "
            "another folder, or the same options"
        )


def frames_in(files: Sequence[Path]) -> int:
    """How many camera frames episodes hold."""
    import numpy as np

    total = 0
    for file in files:
        with np.load(file) as content:
            total += len(content["time_us"])
    return total
