"""LEAD's stack, at its small size: both exporters, names, and what its LiDAR sees."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from models.construct import construct
from models.export import build, export
from models.stacks import LEAD, LEAD_TINY
from models.synthetic_frames import Frame, frames
from models.synthetic_lidar import raster
from models.synthetic_world import Cuboid, EgoPose

PARAMETERS = {
    "backbone": 52_280_640,
    "semantic_decoder": 703_594,
    "bev_semantic_decoder": 37_760,
    "center_net_decoder": 223_258,
    "planning_decoder": 9_682_444,
}


@pytest.fixture(scope="module")
def scene() -> list[Frame]:
    return list(frames(LEAD_TINY, 2, seed=7, scene_length=1))


@pytest.mark.parametrize("opset", [14, 17, 18])
def test_onnxruntime_agrees_with_torch(
    opset: int, scene: list[Frame], tmp_path: Path
) -> None:
    model, file = build("lead-tiny"), tmp_path / "lead.onnx"
    export("lead-tiny", file, opset=opset)
    session = onnxruntime.InferenceSession(file)
    answers = []
    for frame in scene:
        inputs = [torch.from_numpy(frame[name]) for name in LEAD_TINY.inputs]
        got, want = session.run(list(LEAD_TINY.outputs), frame), model(*inputs)
        for one, other in zip(got, want, strict=True):
            error = np.abs(np.asarray(one) - other.numpy()).max()
            assert error < 1e-4 * float(other.abs().max())
        answers.append(got)
    # It sees: every output moves with the frame
    for one, other in zip(*answers, strict=True):
        assert np.abs(one - other).max() > 1e-2 * np.abs(one).max()
    written = {each.name for each in onnx.load(file).graph.initializer}
    assert written >= set(dict(model.named_parameters()))


def test_frames_are_the_inputs(scene: list[Frame]) -> None:
    for spec, (frame, *_) in ((LEAD_TINY, scene), (LEAD, list(frames(LEAD, 1, 0)))):
        assert {name: value.shape for name, value in frame.items()} == spec.inputs
        assert {value.dtype for value in frame.values()} == {np.dtype(np.float32)}
        ahead = [float(frame[name][0, 0]) for name in list(spec.inputs)[-3:]]
        assert ahead[1] < 0 < ahead[0] < ahead[2]
        assert 0 <= frame["rgb"].min() < 50 < 200 < frame["rgb"].max() <= 255


def test_modules_have_the_original_s_parameters() -> None:
    with torch.device("meta"):
        model = construct(LEAD)
    counts = {
        name: sum(parameter.numel() for parameter in module.parameters())
        for name, module in model.named_children()
    }
    assert counts == PARAMETERS


def test_a_box_ahead_to_the_left_is_where_it_stands() -> None:
    box = Cuboid(20.0, 8.0, 0.0, 4.0, 2.0, 1.5, (0.0, 0.0, 0.0))
    there, nothing = (
        raster(EgoPose(0.0, 0.0, 0.0), boxes, (320, 384), np.random.default_rng(0))
        for boxes in ((box,), ())
    )
    rows, columns = np.nonzero(there > nothing + 0.5)
    # Its rear face, 18 m ahead, and its right one, 7 m to the left; four cells a metre
    assert abs(columns.min() - 4 * (32 + 18)) <= 1
    assert abs(rows.max() - 4 * (40 - 7)) <= 1
    # Behind it the ground is not seen
    shadow = there[4 * (40 - 16) : 4 * (40 - 12), 4 * (32 + 35) : 4 * (32 + 40)]
    assert not shadow.any()
