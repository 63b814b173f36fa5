from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import EvaluationError, FramesError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.latency_trace import LatencyTrace, time_shares
from me2e_compress.runtime.profile import (
    BLOCK_RUNS,
    machine_text,
    processor,
    profile,
    record_traces,
)
from me2e_compress.runtime.session import Session, replay
from tests.support.command import write_frames
from tests.support.nets import save_text

MODEL = """counter (float[2] x, float[2] total) => (float[2] total_out)
{ total_out = Add (x, total) }"""
ONES: dict[str, Array] = {"x": np.ones(2, np.float32)}
FRAMES = [Frame(0, True, ONES), Frame(1, False, ONES), Frame(2, False, ONES)]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return save_text(tmp_path / "m.onnx", MODEL)


def test_every_sample_is_one_warm_inference(model: Path) -> None:
    seen = list[tuple[int, int]]()
    trace = profile(
        model,
        FRAMES,
        samples=7,
        warm_up=4,
        on_sample=lambda done, total: seen.append((done, total)),
    )

    assert len(trace.samples_us) == 7
    assert seen == [(0, 7)] * 4 + [(k, 7) for k in range(1, 8)]
    assert trace.model_sha256 == sha256_of(model)
    assert processor() in trace.machine
    assert len(profile(model, FRAMES).samples_us) == 3  # unless said otherwise


def test_state_is_fed_while_it_is_timed(model: Path) -> None:
    session = Session(model, threads=1)

    totals = [float(values["total_out"][0]) for values in replay(session, FRAMES)]

    assert totals == [1.0, 2.0, 3.0]
    assert session.last_us >= 0


@pytest.mark.parametrize(("frames", "samples"), [([], None), (FRAMES, 0)])
def test_nothing_to_measure_is_an_error(
    model: Path, frames: list[Frame], samples: int | None
) -> None:
    with pytest.raises(EvaluationError, match="at least one sample and one frame"):
        profile(model, frames, samples=samples)


def test_one_thread_is_singular() -> None:
    assert machine_text(1) == f"{processor()}, onnxruntime on 1 thread"
    assert machine_text(0).endswith("on all threads")


@pytest.fixture
def models(tmp_path: Path) -> dict[str, Path]:
    found = {name: tmp_path / f"{name}.onnx" for name in ("one", "two")}
    for name, path in found.items():
        save_text(path, MODEL, name=name)
    write_frames(tmp_path / "frames", x=np.ones(2, np.float32))
    return found


@pytest.mark.parametrize("samples", [1, BLOCK_RUNS, 2 * BLOCK_RUNS + 3])
def test_every_model_has_its_samples(
    models: dict[str, Path], tmp_path: Path, samples: int
) -> None:
    told = list[tuple[int, int, str]]()

    traces = record_traces(
        models,
        CalibrationSet(tmp_path / "frames"),
        samples=samples,
        warm_up=1,
        on_sample=lambda *words: told.append(words),
    )

    assert list(traces) == ["one", "two"]
    assert [len(trace.samples_us) for trace in traces.values()] == [samples] * 2
    assert [trace.model_sha256 for trace in traces.values()] == [
        graph.sha256_of(path) for path in models.values()
    ]
    assert [name for *_, name in told[:2]] == ["one", "two"]
    assert all(done < total == 2 * samples for done, total, _ in told)


@pytest.mark.parametrize(("samples", "warm_up"), [(0, 1), (3, -1)])
def test_nothing_to_measure(
    models: dict[str, Path], tmp_path: Path, samples: int, warm_up: int
) -> None:
    frames = CalibrationSet(tmp_path / "frames")

    with pytest.raises(EvaluationError, match="at least one sample and one frame"):
        record_traces(models, frames, samples=samples, warm_up=warm_up)


def test_frames_that_do_not_fit(models: dict[str, Path], tmp_path: Path) -> None:
    write_frames(tmp_path / "wrong", x=np.ones(4, np.float32))

    with pytest.raises(FramesError, match="frame 0"):
        record_traces(models, CalibrationSet(tmp_path / "wrong"), samples=1)


# A trace shows no percentile that it has too few samples for.


WHY = "Not measured: p99 (needs 100 samples, has 16)."


def trace_of(count: int) -> LatencyTrace:
    taken = tuple(range(1, count + 1))
    return LatencyTrace("0", "a CPU", taken, modules_us={"planner": taken})


@pytest.mark.parametrize(("count", "p99"), [(8, None), (99, None), (100, 99)])
def test_p99_needs_100_samples(count: int, p99: int | None) -> None:
    found = trace_of(count)

    assert found.to_json()["p99_us"] == p99
    (module,) = time_shares(found.modules_us)
    assert module.p99_us == p99


def test_what_is_not_told_is_a_dash_with_its_reason() -> None:
    whole, modules = trace_of(16).tables()

    assert [cell.text for cell in whole.rows[2]] == ["p99", "-"]
    assert modules.rows[0][4].text == "-"
    assert whole.note == modules.note == WHY
    assert trace_of(100).tables()[0].note == ""
