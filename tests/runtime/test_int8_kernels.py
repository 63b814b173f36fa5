"""Who times or drives a graph runs it as onnxruntime does; who measures, as written."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.driving import onnx_policy
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.runtime.profile import TimedSession
from me2e_compress.runtime.session import Session
from tests.targets.onnxruntime.rewritten import Drawn


def test_what_is_timed_is_what_onnxruntime_runs(tmp_path: Path) -> None:
    layer = Drawn("Gemm", bias="own")
    path = tmp_path / "layer.onnx"
    graph.save(layer.model(), path)
    frame = layer.frame()
    plain, stock = (
        np.asarray(Session(path, stock=s).run(frame)["y"], np.float64)
        for s in (False, True)
    )

    timed = TimedSession(path, threads=1).run(frame)["y"]

    np.testing.assert_array_equal(timed, stock)
    assert np.abs(plain - stock).max() > 1


def test_what_drives_is_what_onnxruntime_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def refuse(path: Path, **options: object) -> None:
        given.update(options)
        raise GraphError("seen")

    monkeypatch.setattr(onnx_policy, "open_session", refuse)
    with pytest.raises(EvaluationError, match="seen"):
        OnnxPolicy.open(Path("m.onnx"))

    assert given["int8_kernels"] is True
