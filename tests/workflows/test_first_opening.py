"""Opened in a process of its own, once."""

import subprocess
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.errors import GraphError
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session, replay
from me2e_compress.workflows import first_opening
from me2e_compress.workflows.first_opening import try_apart, try_file
from me2e_compress.workflows.listener import SILENT
from tests.stacks import write_stack
from tests.targets.onnxruntime.rewritten import Drawn

COUNTER = """
<ir_version: 8, opset_import: ["" : 17]>
counter (float[2] x, float[2] sum) => (float[2] sum_out) { sum_out = Add(x, sum) }
"""

pytestmark = pytest.mark.opens_apart


def test_a_graph_that_survived_is_not_tried_again(
    driver: ir.Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera: dict[str, Array] = {"camera": np.zeros((1, 4), np.float32)}
    camera["file"] = np.zeros(1)  # a name that numpy's savez takes for its own
    frames = [Frame(0, True, camera)]
    assert try_apart(driver, "driver", frames=frames, memory=tmp_path) is not None
    (verdict,) = tmp_path.iterdir()
    tried: list[object] = []

    def noted(script: Path, words: list[str]) -> object:
        tried.append(script)
        return run_script(script, words)

    monkeypatch.setattr(first_opening, "run_script", noted)

    assert try_apart(driver, "driver", memory=tmp_path) is None
    assert tried == []

    verdict.write_text("{" * 9)  # no verdict at all
    assert try_apart(driver, "driver", frames=frames, memory=tmp_path) is not None
    assert len(tried) == 1


def test_what_it_answers_is_what_a_session_here_would(tmp_path: Path) -> None:
    model = ir.from_onnx_text(COUNTER)
    numbers = np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32)
    # a state that a scene begins with, and one that begins at zero
    frames = [Frame(i, i in (0, 3), {"x": numbers[i]}) for i in range(5)]
    frames[0].arrays["sum"] = numbers[4]

    found = try_apart(model, "counter", frames=frames, memory=tmp_path)

    assert found is not None
    assert found.answers is not None
    here = [each["sum_out"] for each in replay(Session(model), frames)]
    np.testing.assert_array_equal([e["sum_out"] for e in found.answers], here)


def test_what_int8_kernels_answered_there_is_no_answer(tmp_path: Path) -> None:
    layer = Drawn("Gemm", bias="own")
    frames, model = [Frame(0, True, layer.frame())], layer.model()
    model.graph.outputs[0].shape = ir.Shape(layer.shape)

    found = try_apart(model, "layer", frames=frames, memory=tmp_path)

    assert found is not None
    assert found.answers is None


@pytest.mark.parametrize("starts", [True, False])
def test_what_was_made_up_is_no_answer(tmp_path: Path, starts: bool) -> None:
    model = ir.from_onnx_text(COUNTER)
    arrays: dict[str, Array] = {} if starts else {"x": np.ones(2, np.float32)}

    found = try_apart(
        model, "counter", frames=[Frame(0, starts, arrays)], memory=tmp_path
    )

    assert found is not None
    assert found.answers is None


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (-9, "was killed (out of memory?) at step run"),
        (-11, "dies of it (SIGSEGV) at step run"),
        (3221225477, "dies of it (exit code 3221225477) at step run"),
    ],
)
def test_how_it_died(
    driver: ir.Model,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    code: int,
    said: str,
) -> None:
    dead = subprocess.CompletedProcess([], code, "open\nrun\n", "")
    monkeypatch.setattr(first_opening, "run_script", lambda script, words: dead)

    with pytest.raises(GraphError) as caught:
        try_apart(driver, "driver.onnx", memory=tmp_path)

    assert str(caught.value) == f"driver.onnx: onnxruntime {said}"
    assert list(tmp_path.iterdir()) == []


def test_a_crash_of_a_file_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(*_: object, **__: object) -> None:
        raise GraphError("head.onnx: onnxruntime dies of it")

    monkeypatch.setattr(first_opening, "try_apart", dies)

    with pytest.raises(GraphError, match="dies of it"):
        try_file(write_stack(tmp_path).with_name("head.onnx"), SILENT)
