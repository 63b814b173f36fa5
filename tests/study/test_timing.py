import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.latency import NoLatency, TraceLatency
from me2e_compress.errors import EvaluationError
from me2e_compress.graph import sha256_of
from me2e_compress.metrics.measure import Measure
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.runtime.profile import describe_machine
from me2e_compress.study import Condition, Listener, Study, Timing, Variant, outcome
from me2e_compress.study.outcome import Clock, time_all
from me2e_compress.study.prepared import prepare_variant
from me2e_compress.study.workspace import Workspace
from me2e_compress.workflows.result import SILENT
from tests.study.conftest import BLIND, IDEAL, Make

DEVICE = Condition("device", "trace")
SAMPLES = (100, 110, 120, 130, 140)
HERE = describe_machine(1)


def clock_of(study: Study, folder: Path, listener: Listener = SILENT) -> Clock:
    place = Workspace(folder)
    prepared = [
        prepare_variant(study, each, place, listener) for each in study.variants
    ]
    return time_all(study, prepared, place, listener)


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
            name: LatencyTrace(sha256_of(path), HERE, samples)
            for name, path in models.items()
        }

    monkeypatch.setattr(outcome, "record_traces", measured)
    return days


@pytest.fixture
def ours(make: Make) -> Study:
    """Two models, the clock above: five samples, the baseline at 0.24 s."""
    variants = make().variants
    return make(
        variants=(BLIND, variants[1], variants[3]),
        conditions=(IDEAL, DEVICE),
        timing=Timing(len(SAMPLES), baseline_median_s=0.24),
    )


def test_one_scale_gives_the_baseline_its_median_and_each_pays_its_own_latency(
    ours: Study, paced: list[list[str]], tmp_path: Path
) -> None:
    clock = clock_of(ours, tmp_path)

    assert paced == [["slow", "fast"]]
    assert clock.scale == pytest.approx(2000.0)
    assert clock.latency("fast", 50).value == pytest.approx(240.0)
    assert clock.latency("blind", 50).value is None
    blind, _, fast = ours.variants
    pays = TraceLatency(SAMPLES, scale=clock.scale, seed=7)
    assert clock.source(fast, IDEAL, 7) == NoLatency()
    assert clock.source(fast, DEVICE, 7) == pays
    assert clock.source(blind, DEVICE, 7) is None


def test_what_was_measured_is_kept_and_so_was_before_frames_were_named(
    ours: Study, paced: list[list[str]], tmp_path: Path
) -> None:
    assert ours.held_out is not None

    assert clock_of(ours, tmp_path) == clock_of(ours, tmp_path)
    assert len(paced) == 1
    kept = LatencyTrace.load(tmp_path / "traces" / "fast.json")
    assert kept.frames == CalibrationSet(ours.held_out).fingerprint
    for path in (tmp_path / "traces").iterdir():
        record = json.loads(path.read_bytes())
        del record["frames"]
        path.write_text(json.dumps(record))
    clock_of(ours, tmp_path)
    assert len(paced) == 1


def test_a_model_that_joins_later_is_put_on_the_scale_of_the_others(
    ours: Study, make: Make, paced: list[list[str]], tmp_path: Path
) -> None:
    alone = make(variants=ours.variants[1:2], timing=ours.timing)

    clock_of(alone, tmp_path)
    clock = clock_of(ours, tmp_path)

    assert paced == [["slow"], ["slow", "fast"]]
    assert clock.traces["fast"].samples_us == SAMPLES


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model_sha256": "0" * 64}, "another model"),
        ({"samples_us": SAMPLES[:4]}, "4 samples, not 5"),
        ({"machine": "an Orin"}, f"another machine (an Orin; this is {HERE})"),
        ({"frames": "0" * 32}, "other frames"),
    ],
)
def test_a_trace_of_something_else_is_measured_again(
    ours: Study,
    paced: list[list[str]],
    tmp_path: Path,
    change: dict[str, Any],
    words: str,
) -> None:
    warnings = list[str]()
    clock_of(ours, tmp_path)
    stale = tmp_path / "traces" / "fast.json"
    replace(LatencyTrace.load(stale), **change).save(stale)

    clock_of(ours, tmp_path, Listener(on_warning=warnings.append))

    assert paced[1:] == [["slow", "fast"]]
    assert warnings == [f"{stale}: of {words}: measured again"]


@pytest.mark.parametrize(("change", "days"), [({"samples": 3}, 1), ({"threads": 2}, 2)])
def test_fewer_samples_take_what_is_kept_and_more_threads_do_not(
    ours: Study,
    paced: list[list[str]],
    tmp_path: Path,
    change: dict[str, int],
    days: int,
) -> None:
    kept = clock_of(ours, tmp_path)

    again = clock_of(replace(ours, timing=replace(ours.timing, **change)), tmp_path)

    assert len(paced) == days
    assert (again == kept) is (days == 1)


def test_without_a_trace_of_the_baseline_all_are_measured_again(
    ours: Study, paced: list[list[str]], tmp_path: Path
) -> None:
    warnings = list[str]()
    clock_of(ours, tmp_path)
    (tmp_path / "traces" / "slow.json").unlink()

    clock = clock_of(ours, tmp_path, Listener(on_warning=warnings.append))

    assert paced[1:] == [["slow", "fast"]]
    assert clock.latency("fast", 50).value == pytest.approx(240.0)
    stale = tmp_path / "traces" / "fast.json"
    assert warnings == [
        f"{stale}: no trace of the baseline is kept beside it: measured again"
    ]


@pytest.mark.usefixtures("paced")
def test_a_kill_while_traces_are_written_leaves_no_baseline(
    ours: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save, saved = LatencyTrace.save, list[str]()

    def killed(trace: LatencyTrace, path: Path) -> None:
        if saved:
            raise KeyboardInterrupt
        saved.append(path.stem)
        save(trace, path)

    monkeypatch.setattr(LatencyTrace, "save", killed)
    with pytest.raises(KeyboardInterrupt):
        clock_of(ours, tmp_path)

    assert saved == ["fast"]


def test_a_trace_that_is_given_is_taken(
    make: Make, models: Path, paced: list[list[str]], tmp_path: Path
) -> None:
    LatencyTrace("0" * 64, "an Orin", (70_000, 80_000)).save(tmp_path / "orin.json")
    given = Variant("slow", str(models / "slow.onnx"), trace=tmp_path / "orin.json")
    asked = make(
        variants=(given,), conditions=(DEVICE,), timing=Timing(), held_out=None
    )

    clock = clock_of(asked, tmp_path)

    assert paced == []
    assert (clock.scale, clock.latency("slow", 50).value) == (1.0, 70.0)
    assert clock.latency("slow", 99) == Measure(None, "ms", "needs 100 samples, has 2")


def test_a_baseline_without_latency_sets_no_scale(make: Make, tmp_path: Path) -> None:
    asked = make(variants=(BLIND,), baseline="blind")

    with pytest.raises(
        EvaluationError, match=r"median of 0\.2 s of blind, and there is"
    ):
        clock_of(asked, tmp_path)


def test_a_real_clock(make: Make, tmp_path: Path) -> None:
    clock = clock_of(make(timing=Timing(12)), tmp_path)

    assert [len(each.samples_us) for each in clock.traces.values()] == [12, 12, 12]
    assert "in turn" in clock.traces["slow"].machine
