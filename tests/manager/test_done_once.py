"""What a run of the manager does once, or not at all."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph import shapes
from me2e_compress.manager import PassManager, attempt, equivalence
from me2e_compress.passes.base import Context
from me2e_compress.runtime.frames import Frame
from tests.manager import passes
from tests.manager.test_pass_manager import CHAIN


def test_a_pass_s_graph_is_written_once_for_checker_and_inference(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[ir.Model] = []
    plainly = shapes.without_weights

    def noted(model: ir.Model) -> onnx.ModelProto:
        written.append(model)
        return plainly(model)

    for home in (shapes, attempt):
        monkeypatch.setattr(home, "without_weights", noted)
    monkeypatch.setattr("me2e_compress.graph.validity.without_weights", noted)
    chosen = (passes.DROPS_RELU,)
    PassManager(chosen, verify_frames=0).run(ir.from_onnx_text(CHAIN), context)

    assert len(written) == 3  # as given, imported, rewritten


def _record(folder: Path) -> None:
    (folder / "scenes.json").write_text('{"scenes": [0]}')
    np.savez(folder / "000000.npz", x=np.ones((1, 8), np.float32))


def test_a_graph_whose_answers_are_known_is_not_opened_again(
    context: Context, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = ir.from_onnx_text(CHAIN)
    _record(tmp_path)
    tried: list[tuple[str, float]] = []

    def first(
        model: ir.Model, name: str, frames: Sequence[Frame]
    ) -> equivalence.Answers:
        tried.append((name, frames[0].arrays["x"].sum().item()))
        return [{"y": np.array([[2.0]], np.float32)}]

    def opens(*_: object, **__: object) -> None:
        raise AssertionError("a session was opened")

    monkeypatch.setattr("me2e_compress.manager.verification_inputs.Session", opens)
    answers: equivalence.Answers = [{"y": np.array([[2.0 + 1e-4]], np.float32)}]
    manager = PassManager(
        (passes.DROPS_RELU,),
        samples=CalibrationSet(tmp_path),
        try_first=first,
        answers=answers,
    )
    (check,) = manager.run(model, context).verifications

    assert tried == [("the graph after drops-relu-of-sigmoid", 8.0)]
    assert check.errors["y"] == pytest.approx(5e-5, rel=0.01)


def test_answers_of_the_graph_that_came_in_are_not_those_of_a_later_one(
    context: Context, tmp_path: Path
) -> None:
    _record(tmp_path)
    wrong: equivalence.Answers = [{"y": np.zeros((1, 8), np.float32)}]
    manager = PassManager(
        (passes.HALVES, passes.DROPS_RELU),
        samples=CalibrationSet(tmp_path),
        answers=wrong,
    )
    check = manager.run(ir.from_onnx_text(CHAIN), context).verifications[-1]

    assert check.errors == {"y": 0.0}
