from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import SILENT
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.latency import NoLatency, TraceLatency
from me2e_compress.graph import sha256_of
from me2e_compress.metrics.measure import Measure
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.runtime.profile import in_turn_text
from me2e_compress.study import Condition, Listener, Study, Timing, Variant, outcome
from me2e_compress.study.outcome import Clock, time_all
from me2e_compress.study.prepared import prepare_variant
from me2e_compress.study.workspace import Workspace
from tests.study.conftest import BLIND, IDEAL, Make
from tests.support.command import write_frames

DEVICE = Condition("device", "trace")
SAMPLES = (100, 110, 120, 130, 140)
HERE = in_turn_text(1)


def clock_of(study: Study, folder: Path, listener: Listener = SILENT) -> Clock:
    place = Workspace(folder)
    prepared = [
        prepare_variant(study, variant, place, listener) for variant in study.variants
    ]
    return time_all(study, prepared, place, listener)


@pytest.fixture
def paced(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The clock is ours: everything takes twice as long on every further day."""
    days = list[list[str]]()

    def record(models: Mapping[str, Path], *_: object, **__: object) -> object:
        days.append(list(models))
        samples = tuple(2 ** (len(days) - 1) * sample for sample in SAMPLES)
        digests = {name: sha256_of(path) for name, path in models.items()}
        return {name: LatencyTrace(own, HERE, samples) for name, own in digests.items()}

    monkeypatch.setattr(outcome, "record_traces", record)
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


def test_what_was_measured_together_is_kept(
    ours: Study, paced: list[list[str]], tmp_path: Path
) -> None:
    assert ours.held_out is not None

    assert clock_of(ours, tmp_path) == clock_of(ours, tmp_path)
    assert len(paced) == 1
    for path in (tmp_path / "traces").iterdir():
        kept = LatencyTrace.load(path)
        assert kept.frames == CalibrationSet(ours.held_out).fingerprint


def test_a_model_that_joins_later_is_measured_with_the_others(
    ours: Study, make: Make, paced: list[list[str]], tmp_path: Path
) -> None:
    alone = make(variants=ours.variants[1:2], timing=ours.timing)

    before = clock_of(alone, tmp_path)
    clock = clock_of(ours, tmp_path)

    assert paced == [["slow"], ["slow", "fast"]]
    assert clock.traces["fast"].samples_us == clock.traces["slow"].samples_us
    assert clock_of(alone, tmp_path) == before


def test_what_was_measured_otherwise_is_measured_again(
    ours: Study, paced: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other samples, threads, frames or models, or another machine."""
    clock_of(ours, tmp_path)
    write_frames(tmp_path / "others", command=np.array([2]))
    blind, slow, fast = ours.variants
    other = replace(fast, policy=slow.policy)

    for changed in (
        replace(ours, timing=replace(ours.timing, samples=3)),
        replace(ours, timing=replace(ours.timing, threads=2)),
        replace(ours, held_out=tmp_path / "others"),
        replace(ours, variants=(blind, slow, other)),
    ):
        days = len(paced)
        clock_of(changed, tmp_path)
        assert len(paced) == days + 1
    monkeypatch.setattr(outcome, "in_turn_text", lambda *_: "an Orin")
    clock_of(ours, tmp_path)
    assert len(paced) == 6


def test_a_kill_while_traces_are_written_leaves_no_set(
    ours: Study, paced: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save, saved = LatencyTrace.save, list[Path]()

    def killed(trace: LatencyTrace, path: Path) -> None:
        if saved:
            raise KeyboardInterrupt
        saved.append(path)
        save(trace, path)

    with monkeypatch.context() as patched:
        patched.setattr(LatencyTrace, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            clock_of(ours, tmp_path)
    clock = clock_of(ours, tmp_path)

    assert paced == [["slow", "fast"]] * 2
    assert clock.traces["slow"].samples_us == clock.traces["fast"].samples_us


def test_a_trace_that_is_given_is_taken(
    make: Make, models: Path, paced: list[list[str]], tmp_path: Path
) -> None:
    LatencyTrace("0" * 64, "an Orin", (70_000, 80_000)).save(tmp_path / "orin.json")
    given = Variant("slow", str(models / "slow.onnx"), trace=tmp_path / "orin.json")
    own = make(variants=(given,), conditions=(DEVICE,), timing=Timing(), held_out=None)

    clock = clock_of(own, tmp_path)

    assert paced == []
    assert (clock.scale, clock.latency("slow", 50).value) == (1.0, 70.0)
    assert clock.latency("slow", 99) == Measure(None, "ms", "needs 100 samples, has 2")


def test_a_baseline_without_latency_sets_no_scale(make: Make, tmp_path: Path) -> None:
    asked = make(variants=(BLIND,), baseline="blind")

    words = r"median of 0\.2 s of blind, and there is"
    with pytest.raises(EvaluationError, match=words):
        clock_of(asked, tmp_path)


def test_a_real_clock(make: Make, tmp_path: Path) -> None:
    clock = clock_of(make(timing=Timing(12)), tmp_path)

    assert [len(trace.samples_us) for trace in clock.traces.values()] == [12, 12, 12]
    assert "in turn" in clock.traces["slow"].machine
