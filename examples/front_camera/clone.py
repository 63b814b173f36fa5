"""A front-camera policy, cloned from the driver that ships in seconds, without torch.

A picture of the front camera, pooled to 6 x 20 cells, the speed and the target point go
through a fixed random layer; the only thing learnt is a ridge regression of the
driver's next two seconds on it.

    python clone.py blank.onnx
    me2e-compress frames blank.onnx --adapter front.toml -n 480 -o frames/
    python clone.py front.onnx --frames frames/
"""

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from me2e_compress import CalibrationSet

Floats = npt.NDArray[np.float64]

POOL = 8
CELLS, STATE, UNITS = 3 * 6 * 20, 3, 200
FEATURES = CELLS + STATE + UNITS + 1
STEPS = 4
"""Waypoints, every 0.5 s as the frames are."""
STIFFNESS = 30.0
"""Of the regression: how much a weight costs."""


def random_layer(seed: int = 0) -> Floats:
    """Draw the fixed layer [cells and state and 1, units]; the state weighs more."""
    drawn = np.random.default_rng(seed).normal(size=(CELLS + STATE + 1, UNITS))
    drawn[:CELLS] *= 0.3 / np.sqrt(CELLS)
    return drawn


def features(image: Floats, state: Floats) -> Floats:
    """Return what is regressed on [features], as the graph computes it."""
    rows, columns = (side // POOL for side in image.shape[-2:])
    cells = image.reshape(3, rows, POOL, columns, POOL).mean((2, 4)).reshape(-1)
    seen = np.concatenate([cells, state.reshape(-1), [1.0]])
    return np.concatenate([seen, np.maximum(seen @ random_layer(), 0.0)])


def examples(folder: Path) -> tuple[Floats, Floats]:
    """Return features [n, features] and the ways driven after them [n, 4, 2]."""
    frames = list(CalibrationSet(folder))
    xs, ways = list[Floats](), list[Floats]()
    for at, frame in enumerate(frames[:-STEPS]):
        after = frames[at + 1 : at + 1 + STEPS]
        if any(each.starts_scene for each in after):
            continue
        moved = np.cumsum([each.arrays["can_bus"][:2] for each in after], axis=0)
        heading = float(frame.arrays["can_bus"][16])
        cos, sin = np.cos(heading), np.sin(heading)
        ways.append(moved @ np.array([[cos, -sin], [sin, cos]]))
        image, state = (
            np.asarray(frame.arrays[name], np.float64) for name in ("image", "state")
        )
        xs.append(features(image, state))
    return np.array(xs), np.array(ways)


def fitted(xs: Floats, ways: Floats) -> Floats:
    """Return the weights [features, 8] of the regression."""
    cost = STIFFNESS * np.eye(xs.shape[1])
    found = np.linalg.solve(xs.T @ xs + cost, xs.T @ ways.reshape(len(ways), -1))
    return np.asarray(found, np.float64)


def network(weights: Floats | None) -> onnx.ModelProto:
    """Build the graph; without weights it stands still, and asks for the CAN bus too.

    That is how frames are recorded for it: the CAN bus tells where the driver drove.
    """
    learnt = np.zeros((FEATURES, 2 * STEPS)) if weights is None else weights
    nodes = [
        helper.make_node("AveragePool", ["image"], ["cells"], kernel_shape=[POOL] * 2,
                         strides=[POOL] * 2),
        helper.make_node("Flatten", ["cells"], ["flat"]),
        helper.make_node("Concat", ["flat", "state", "one"], ["seen"], axis=1),
        helper.make_node("MatMul", ["seen", "random"], ["drawn"]),
        helper.make_node("Relu", ["drawn"], ["units"]),
        helper.make_node("Concat", ["seen", "units"], ["features"], axis=1),
        helper.make_node("MatMul", ["features", "learnt"], ["numbers"]),
        helper.make_node("Reshape", ["numbers", "shape"], ["waypoints"]),
    ]  # fmt: skip
    inputs = {"image": (1, 3, 48, 160), "state": (1, STATE)}
    if weights is None:
        inputs["can_bus"] = (18,)
    constants = {"one": np.ones((1, 1)), "random": random_layer(), "learnt": learnt}
    graph = helper.make_graph(
        nodes,
        "front_camera",
        [_port(name, shape) for name, shape in inputs.items()],
        [_port("waypoints", (1, STEPS, 2))],
        [
            *(
                numpy_helper.from_array(v.astype(np.float32), k)
                for k, v in constants.items()
            ),
            numpy_helper.from_array(np.array([1, STEPS, 2]), "shape"),
        ],
    )
    opset = helper.make_opsetid("", 17)
    return helper.make_model(graph, opset_imports=[opset], ir_version=8)


def _port(name: str, shape: tuple[int, ...]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def main() -> None:
    """Write the graph, of frames or none."""
    parser = argparse.ArgumentParser(description="Clone a front-camera policy.")
    parser.add_argument("output", type=Path, help="the ONNX file")
    parser.add_argument("--frames", type=Path, help="recorded for the graph of none")
    asked = parser.parse_args()
    learnt = None if asked.frames is None else fitted(*examples(asked.frames))
    onnx.save(network(learnt), asked.output)


if __name__ == "__main__":
    main()
