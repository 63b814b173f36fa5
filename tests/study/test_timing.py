from collections.abc import Mapping
from pathlib import Path

import pytest

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.latency import FixedLatency, TraceLatency
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.study import Condition, Listener, Scheme, Study, Timing, timing
from me2e_compress.study.models import contend
from me2e_compress.study.timing import Clock, time_all
from me2e_compress.study.workplace import SILENT, Workplace
from tests.study.conftest import BLIND, IDEAL, Make

DEVICE = Condition("device", "trace")
SAMPLES = (100, 110, 120, 130, 140)


def clock_of(study: Study, folder: Path, listener: Listener = SILENT) -> Clock:
    place = Workplace(folder)
    contenders = [contend(study, each, place, listener) for each in study.schemes]
    return time_all(study, contenders, place, listener)


@pytest.fixture
def paced(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The clock is ours: everything takes twice as long on every further day."""
    days = list[list[str]]()

    def measured(
        models: Mapping[str, Path], *_: object, **__: object
    ) -> dict[str, LatencyTrace]:
        days.append(list(models))
        factor = 2 ** (len(days) - 1)
        samples = tuple(factor * each for each in SAMPLES)
        return {
            name: LatencyTrace(sha256_of(path), "here", samples)
            for name, path in models.items()
        }

    monkeypatch.setattr(timing, "traces_in_turn", measured)
    return days


@pytest.fixture
def ours(make: Make) -> Study:
    """Two models, the clock above: five samples, the baseline at 0.24 s."""
    schemes = make().schemes
    return make(
        schemes=(BLIND, schemes[1], schemes[3]),
        conditions=(IDEAL, DEVICE),
        timing=Timing(len(SAMPLES), baseline_median_s=0.24),
    )


def test_one_scale_gives_the_baseline_the_median_asked_for(
    ours: Study, paced: list[list[str]], tmp_path: Path
) -> None:
    clock = clock_of(ours, tmp_path)

    assert paced == [["slow", "fast"]]
    assert clock.scale == pytest.approx(2000.0)
    assert clock.milliseconds("fast", 50) == pytest.approx(240.0)
    assert clock.milliseconds("blind", 50) is None


@pytest.mark.usefixtures("paced")
def test_each_scheme_pays_its_own_latency(ours: Study, tmp_path: Path) -> None:
    clock = clock_of(ours, tmp_path)
    blind, _, fast = ours.schemes

    assert clock.source(fast, IDEAL, 7) == FixedLatency()
    assert clock.source(fast, DEVICE, 7) == TraceLatency(
        SAMPLES, scale=clock.scale, seed=7
    )
    assert clock.source(blind, DEVICE, 7) is None


def test_what_was_measured_is_kept(
    ours: Study, paced: list[list[str]], tmp_path: Path
) -> None:
    assert clock_of(ours, tmp_path) == clock_of(ours, tmp_path)
    assert len(paced) == 1


def test_a_model_that_joins_later_is_put_on_the_scale_of_the_others(
    ours: Study, make: Make, paced: list[list[str]], tmp_path: Path
) -> None:
    alone = make(schemes=ours.schemes[1:2], timing=ours.timing)

    clock_of(alone, tmp_path)
    clock = clock_of(ours, tmp_path)

    assert paced == [["slow"], ["slow", "fast"]]
    assert clock.traces["fast"].samples_us == SAMPLES


def test_a_trace_of_another_model_is_measured_again(
    ours: Study, paced: list[list[str]], tmp_path: Path
) -> None:
    warnings = list[str]()
    clock_of(ours, tmp_path)
    stale = tmp_path / "traces" / "fast.json"
    LatencyTrace("0" * 64, "there", SAMPLES).save(stale)

    clock_of(ours, tmp_path, Listener(on_warning=warnings.append))

    assert paced[1:] == [["slow", "fast"]]
    assert warnings == [f"{stale}: of another model or length: measured again"]


def test_a_trace_that_is_given_is_taken(
    make: Make, models: Path, paced: list[list[str]], tmp_path: Path
) -> None:
    LatencyTrace("0" * 64, "an Orin", (70_000, 80_000)).save(tmp_path / "orin.json")
    given = Scheme("slow", str(models / "slow.onnx"), trace=tmp_path / "orin.json")
    asked = make(schemes=(given,), conditions=(DEVICE,), timing=Timing(), held_out=None)

    clock = clock_of(asked, tmp_path)

    assert paced == []
    assert (clock.scale, clock.milliseconds("slow", 99)) == (1.0, 80.0)


def test_a_baseline_without_latency_sets_no_scale(make: Make, tmp_path: Path) -> None:
    asked = make(schemes=(BLIND,), baseline="blind")

    with pytest.raises(
        EvaluationError, match=r"median of 0\.2 s of blind, and there is"
    ):
        clock_of(asked, tmp_path)


def test_a_real_clock(make: Make, tmp_path: Path) -> None:
    clock = clock_of(make(timing=Timing(12)), tmp_path)

    assert [len(each.samples_us) for each in clock.traces.values()] == [12, 12, 12]
    assert "in turn" in clock.traces["slow"].machine
