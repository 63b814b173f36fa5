"""A small stack with state and pictures, and an engine of it."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session
from tests.support.nets import parsed, stored

Arrays: TypeAlias = dict[str, Any]
SCENES = (0, 4)
COUNT = 8

_TEXT = """
stack (float[1,3,3,8,8] img, float[1,3,4,4] lidar2img, float[4] ego, float[1,16] prev,
       float[192,8] w_seen, float[3,8] w_camera, float[92,16] w_all, float[16,8] w_plan,
       float[16,30] w_boxes)
 => (float[1,4,2] plan, float[1,5,6] boxes, float[1,16] prev_out)
<int64[2] by_camera = {3, 192}, int64[2] row = {1, -1},
 int64[3] points = {1, 4, 2}, int64[3] agents = {1, 5, 6}> {
    flat = Reshape(img, by_camera)
    seen = MatMul(flat, w_seen)
    own = Mul(seen, w_camera)
    rows = Reshape(own, row)
    matrices = Reshape(lidar2img, row)
    status = Reshape(ego, row)
    all = Concat<axis = 1>(rows, matrices, status, prev)
    mixed = MatMul(all, w_all)
    prev_out = Tanh(mixed)
    planned = MatMul(prev_out, w_plan)
    plan = Reshape(planned, points)
    found = MatMul(prev_out, w_boxes)
    boxes = Reshape(found, agents)
}
"""
_SHAPES = {
    "w_seen": (192, 8), "w_camera": (3, 8), "w_all": (92, 16), "w_plan": (16, 8),
    "w_boxes": (16, 30),
}  # fmt: skip


def stack() -> ir.Model:
    """Return the stack, with random weights."""
    drawn = np.random.default_rng(1)
    weights = {
        name: drawn.normal(0, 1 / np.sqrt(shape[0]), shape).astype(np.float32)
        for name, shape in _SHAPES.items()
    }
    return stored(parsed(_TEXT), weights)


def frames() -> list[Frame]:
    """Return two scenes of frames that move."""
    drawn = np.random.default_rng(2)
    return [
        Frame(index, index in SCENES, {
            "img": drawn.normal(0, 1, (1, 3, 3, 8, 8)).astype(np.float32),
            "lidar2img": drawn.normal(0, 1, (1, 3, 4, 4)).astype(np.float32),
            "ego": drawn.normal(0, 1, 4).astype(np.float32),
        })
        for index in range(COUNT)
    ]  # fmt: skip


def drive(
    session: Session, shown: Sequence[Frame], before: Sequence[Arrays] = ()
) -> list[Arrays]:
    """Return the answers before, and what an engine answers then, reset by scene."""
    given = list(before)
    for frame in shown:
        state = {"prev": given[-1]["prev_out"]} if given else {}
        if frame.starts_scene:
            state = session.first_state({})
        answers = session.run({**frame.arrays, **state})
        given.append({name: np.array(value) for name, value in answers.items()})
    return given


def noisy(given: list[Arrays], decibels: float) -> list[Arrays]:
    """Return answers with noise, as another program's arithmetic leaves it."""
    drawn = np.random.default_rng(3)
    return [
        {
            name: (
                each
                + drawn.normal(0, 1, each.shape)
                * np.sqrt(np.mean(each**2))
                * 10 ** (-decibels / 20)
            ).astype(each.dtype)
            for name, each in answers.items()
        }
        for answers in given
    ]
