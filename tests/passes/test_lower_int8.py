from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError, PreconditionError
from me2e_compress.fidelity.compare import compare
from me2e_compress.graph import provenance
from me2e_compress.manager import PassManager
from me2e_compress.passes import Context
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime import (
    int8_layers,
    unranged,
)
from tests.frames import record
from tests.nets import MODULES, conv_attention, image, net

FOR_TENSORRT = QuantizeInt8(rules="paper", target="tensorrt")


@pytest.fixture
def frames(tmp_path: Path) -> CalibrationSet:
    return CalibrationSet(record(tmp_path / "f", [image(i) for i in range(4)], (0, 2)))


@pytest.fixture
def context(frames: CalibrationSet) -> Context:
    return Context(MODULES, frames)


def test_what_was_placed_for_tensorrt_is_lowered(
    context: Context, frames: CalibrationSet
) -> None:
    model = conv_attention()
    placed = FOR_TENSORRT.run(model.clone(), context).model

    result = LowerInt8().run(placed, context)

    assert result.changes == len(int8_layers(result.model)) == 2
    assert "2 layers in int8 for onnxruntime" in result.notes
    found = compare(Session(model), Session(result.model), frames)
    assert all(20 < each.sqnr_db < 60 for each in found.outputs)


def test_the_manager_takes_both_passes_in_a_row(context: Context) -> None:
    manager = PassManager((FOR_TENSORRT, LowerInt8()), verify_frames=0)

    report = manager.run(conv_attention(), context)

    assert [step.changes for step in report.steps] == [4, 2]
    assert not provenance.missing(report.model)


def test_the_target_onnxruntime_needs_no_second_pass(context: Context) -> None:
    result = QuantizeInt8(rules="paper", target="onnxruntime").run(
        conv_attention(), context
    )

    assert len(int8_layers(result.model)) == 2
    with pytest.raises(PreconditionError, match="only symmetric int8"):
        LowerInt8().run(result.model, context)


def test_saved_ranges_give_the_same_graph_without_frames(
    context: Context, frames: CalibrationSet, tmp_path: Path
) -> None:
    placed = FOR_TENSORRT.run(conv_attention(), context).model
    path = tmp_path / "r.json"
    Calibrator().run(placed, unranged(placed), frames).save(path)

    measured = LowerInt8().run(placed, context).model
    read = LowerInt8(ranges=path).run(placed, Context(MODULES)).model

    assert graph.digest(read) == graph.digest(measured)


def test_without_frames_there_is_no_calibration(context: Context) -> None:
    placed = FOR_TENSORRT.run(conv_attention(), context).model

    with pytest.raises(FramesError, match=r"lower-int8 needs recorded .* never made"):
        LowerInt8().run(placed, Context(MODULES))


def test_a_float_graph_is_refused(context: Context) -> None:
    with pytest.raises(PreconditionError, match="no quantized activation"):
        LowerInt8().run(conv_attention(), context)


def test_pairs_without_a_kernel_are_taken_out(context: Context) -> None:
    text = """
    <ir_version: 9, opset_import: ["" : 17]>
    batched (float[1,3,8,8] image, float[1,3,8,4] w) => (float[1,3,8,4] y) {
        y = MatMul(image, w)
    }
    """
    weight = np.random.default_rng(0).standard_normal((1, 3, 8, 4))
    model = net(text, {"w": weight})

    manager = PassManager((FOR_TENSORRT, LowerInt8()), verify_frames=0)
    report = manager.run(model, context)

    assert [step.changes for step in report.steps] == [1, 1]
    assert "0 layers in int8 for onnxruntime" in report.steps[1].notes
