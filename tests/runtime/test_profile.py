from pathlib import Path

import numpy as np
import onnx
import pytest

from me2e_compress.errors import EvaluationError
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.profile import (
    TimedSession,
    machine_words,
    processor,
    profile,
)
from me2e_compress.runtime.session import replay

MODEL = """<ir_version: 8, opset_import: ["" : 17]>
counter (float[2] x, float[2] total) => (float[2] total_out)
{ total_out = Add (x, total) }"""
ONES: dict[str, Array] = {"x": np.ones(2, np.float32)}
FRAMES = [Frame(0, True, ONES), Frame(1, False, ONES), Frame(2, False, ONES)]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    onnx.save(onnx.parser.parse_model(MODEL), tmp_path / "m.onnx")
    return tmp_path / "m.onnx"


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


def test_one_sample_a_frame_unless_said_otherwise(model: Path) -> None:
    assert len(profile(model, FRAMES).samples_us) == 3


def test_state_is_fed_while_it_is_timed(model: Path) -> None:
    session = TimedSession(model, threads=1)

    totals = [float(values["total_out"][0]) for values in replay(session, FRAMES)]

    assert totals == [1.0, 2.0, 3.0]
    assert len(session.taken_us) == 3


@pytest.mark.parametrize(("frames", "samples"), [([], None), (FRAMES, 0)])
def test_nothing_to_measure_is_an_error(
    model: Path, frames: list[Frame], samples: int | None
) -> None:
    with pytest.raises(EvaluationError, match="at least one sample and one frame"):
        profile(model, frames, samples=samples)


def test_one_thread_is_singular() -> None:
    assert machine_words(1) == f"{processor()}, onnxruntime on 1 thread"
    assert machine_words(0).endswith("on all threads")
