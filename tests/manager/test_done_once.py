"""What a run of the manager does once, or not at all."""

import onnx
import onnx_ir as ir
import pytest

from me2e_compress.calibration.stream import Recording
from me2e_compress.errors import GraphError
from me2e_compress.graph import shapes
from me2e_compress.manager import PassManager, attempt
from me2e_compress.passes.base import Context
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


def test_a_graph_that_kills_its_process_is_refused_before_it_is_run(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(model: ir.Model, name: str, frames: Recording | None) -> None:
        raise GraphError(f"{name} kills {frames}")

    def opens(*_: object, **__: object) -> None:
        raise AssertionError("a session was opened")

    monkeypatch.setattr("me2e_compress.manager.verification_inputs.Session", opens)
    manager = PassManager((passes.DROPS_RELU,), try_first=refuses)
    with pytest.raises(GraphError, match="the graph after drops-relu-of-sigmoid kills"):
        manager.run(ir.from_onnx_text(CHAIN), context)
