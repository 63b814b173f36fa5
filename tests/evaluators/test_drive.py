"""A drive of words, and evaluators that declare what they take of it."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar, cast

import pytest

from me2e_compress import EvaluateOptions, evaluate
from me2e_compress.base import registry
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import Listener
from me2e_compress.commands.evaluate import drive_of
from me2e_compress.driving.latency import FrameRate
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators import EVALUATORS, Drive, Evaluator
from me2e_compress.evaluators.contract import evaluator_named
from me2e_compress.evaluators.highway.evaluator import Highway
from me2e_compress.metrics.episode import Episode


def test_words_reach_the_drive() -> None:
    options = EvaluateOptions(
        latency="fps:5", dt_ms=25, weather="night=0.5", routes=cast("str", 2)
    )

    drive = drive_of(options, Highway())

    assert drive.latency == FrameRate(5.0)
    assert drive.dt_us == 25_000
    assert drive.weather.night == 0.5
    assert (len(drive.routes), drive.set_size) == (2, 220)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"routes": "nowhere"}, "no route 'nowhere'"),
        ({"latency": "slow"}, "no latency source 'slow'"),
        ({"weather": "hail=1"}, "weather option hail: .* there are fog_m"),
        ({"weather": "fog_m=0.0"}, "fog_m: Input should be greater than or equal to 1"),
        ({"weather": "night=1.5"}, "night: Input should be less than or equal to 1"),
        ({"weather": "rain=-0.1"}, "rain: Input should be greater than or equal to 0"),
        ({"weather": "brightness=9"}, "brightness: Input should be less than or equal"),
        ({"weather": "noise=nan"}, "noise: Input should be less than or equal to 64"),
        ({"weather": "dropped=TOP"}, "dropped: Input should be 'FRONT', 'FRONT_LEFT'"),
        ({"weather": "seed=-1"}, "seed: Input should be greater than or equal to 0"),
        ({"dt_ms": 1e308}, r"a step of 1e\+308 ms: it must divide 50 ms"),
        ({"dt_ms": float("nan")}, "a step of nan ms"),
        ({"engine": "cloud"}, "no engine 'cloud'; there are local, ray and ray:A"),
        ({"engine": "local:here"}, "no engine 'local:here'"),
        ({"latency_model": "lifo"}, "no latency model 'lifo'; there are drop, fifo"),
    ],
)
def test_a_wrong_word_is_named_before_anything_drives(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        evaluate("blind", tmp_path / "r", EvaluateOptions(**options))
    assert not (tmp_path / "r").exists()


@dataclass(frozen=True)
class Declared(Evaluator):
    """Declares what it does not have."""

    name: ClassVar[str] = "declared"

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        yield from ()


@dataclass(frozen=True)
class Undeclared:
    """No evaluator at all."""

    name: ClassVar[str] = "declared"


@pytest.mark.parametrize(
    ("takes", "message"),
    [
        ({"routes"}, r"^declared declares routes, but has no routes\(\)$"),
        ({"latency", "render"}, r"^declared declares render, but has no render\(\)$"),
        ({"speed"}, "^declared declares 'speed', which nobody asks for; there are pol"),
        (None, "is a Undeclared, which is no Evaluator: derive it from me2e_compress"),
    ],
)
def test_who_declares_what_it_does_not_have_is_refused(
    monkeypatch: pytest.MonkeyPatch, takes: set[str] | None, message: str
) -> None:
    cls = Undeclared if takes is None else Declared
    monkeypatch.setattr(Declared, "takes", frozenset(takes or ()))
    entry = EntryPoint("declared", "anywhere:Class", EVALUATORS.group)
    monkeypatch.setattr(EntryPoint, "load", lambda entry: cls)
    monkeypatch.setattr(
        registry, "_all_entry_points", lambda path: {EVALUATORS.group: (entry,)}
    )

    with pytest.raises(EvaluationError, match=message):
        evaluator_named("declared")


def test_a_word_that_an_evaluator_cannot_read_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Highway, "routes", lambda self, words: int(words))
    with pytest.raises(EvaluationError, match=r"^--routes two: invalid literal"):
        drive_of(EvaluateOptions(routes="two"), Highway())
