from pathlib import Path

import numpy as np
import onnx
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import EvaluationError, FramesError
from me2e_compress.runtime.profile import BLOCK, record_traces
from tests.command import write_frames

TEXT = """<ir_version: 8, opset_import: ["" : 17]>
model (float[3] x, float[3] s) => (float[3] y, float[3] s_out) {
    s_out = Add (s, x)
    y = Mul (s_out, x)
}"""


@pytest.fixture
def models(tmp_path: Path) -> dict[str, Path]:
    found = {name: tmp_path / f"{name}.onnx" for name in ("one", "two")}
    for name, path in found.items():
        model = onnx.parser.parse_model(TEXT)
        model.doc_string = name
        onnx.save(model, path)
    write_frames(tmp_path / "frames", x=np.ones(3, np.float32))
    return found


@pytest.mark.parametrize("samples", [1, BLOCK, 2 * BLOCK + 3])
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
