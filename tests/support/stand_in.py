"""A tiny driver with the modules and the interface of the one that ships."""

import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from me2e_compress.shipped import drivers
from me2e_compress.shipped.drivers import SHIPPED
from tests.support.frames import record

WIDTH = 8
BODY = """
    ["/backbone/ReduceMean"] pooled = ReduceMean <axes = [3, 4], keepdims = 0> (img)
    ["/backbone/Flatten"] pixels = Flatten (pooled)
    ["/backbone/MatMul"] features = MatMul (pixels, "backbone.weight")
    ["/neck/MatMul"] narrow = MatMul (features, "neck.weight")
    ["/bev_encoder/Reshape"] bus = Reshape (can_bus, "bev_encoder.shape")
    ["/bev_encoder/MatMul"] moved = MatMul (bus, "bev_encoder.weight")
    ["/bev_encoder/Mul"] recalled = Mul (prev_bev, "bev_encoder.decay")
    ["/bev_encoder/Add"] seen = Add (narrow, moved)
    ["/bev_encoder/Add_1"] blended = Add (seen, recalled)
    ["/bev_encoder/Tanh"] prev_bev_out = Tanh (blended)
    ["/track/MatMul"] agents = MatMul (prev_bev_out, "track.weight")
    ["/track/ArgMax"] nearest = ArgMax <axis = 1, keepdims = 1> (agents)
    ["/map/MatMul"] lines = MatMul (prev_bev_out, "map.weight")
    ["/map/Sigmoid"] lanes = Sigmoid (lines)
    ["/motion/MatMul"] futures = MatMul (agents, "motion.weight")
    ["/motion/Add"] motions = Add (futures, lanes)
    ["/occ/MatMul"] cells = MatMul (prev_bev_out, "occ.weight")
    ["/occ/Sigmoid"] occupancy = Sigmoid (cells)
    ["/planner/Sub"] elapsed = Sub (timestamp, prev_memory)
    ["/planner/Cast"] order = Cast <to = 1> (nearest)
    ["/planner/Cast_1"] told = Cast <to = 1> (command)
    ["/planner/Reshape"] told_row = Reshape (told, "planner.row")
    ["/planner/Reshape_1"] elapsed_row = Reshape (elapsed, "planner.row")
    ["/planner/Concat"] query = Concat <axis = 1> (
        prev_bev_out, agents, motions, occupancy, order, told_row, elapsed_row)
    ["/planner/MatMul"] steer = MatMul (query, "planner.weight")
    ["/planner/Reshape_2"] offsets = Reshape (steer, "planner.shape")
    ["/planner/Add"] plan = Add (offsets, "planner.ahead")
    ["/planner/Identity"] prev_memory_out = Identity (timestamp)
"""
ROWS = ("agents", "lanes", "motions", "occupancy", "prev_bev_out")
OUTPUTS = {
    "plan": (1, 6, 2),
    **dict.fromkeys(ROWS, (1, WIDTH)),
    "prev_memory_out": (1,),
}
METADATA = {
    "me2e.stack": "highway",
    "me2e.image": json.dumps(
        {"input": "img", "mean": [100, 110, 120], "std": [50, 60, 70], "order": "rgb"}
    ),
}


def write_model(path: Path, *, size: tuple[int, int] = (16, 24), seed: int = 0) -> Path:
    """Write it; its plan goes 4 m/s straight ahead, more or less."""
    rows, columns = size
    outputs = ", ".join(
        f"float[{', '.join(map(str, shape))}] {name}" for name, shape in OUTPUTS.items()
    )
    model = onnx.parser.parse_model(
        f"""<ir_version: 8, opset_import: ["" : 17]>
        highway (float[1, 6, 3, {rows}, {columns}] img, float[1, 6, 4, 4] lidar2img,
            float[18] can_bus, int64[1] command, float[1] timestamp,
            float[1, {WIDTH}] prev_bev, float[1] prev_memory) => ({outputs})
        {{ {BODY} }}"""
    )
    for name, value in _weights(seed).items():
        model.graph.initializer.append(numpy_helper.from_array(value, name))
    for key, text in METADATA.items():
        model.metadata_props.add(key=key, value=text)
    onnx.save(model, path)
    return path


def write_shipped(folder: Path) -> None:
    """Write a model and a card that fits it for all that ship, as the package does."""
    folder.mkdir(exist_ok=True)
    for seed, name in enumerate(SHIPPED):
        content = write_model(folder / f"{name}.onnx", seed=seed).read_bytes()
        card = {
            "sha256": hashlib.sha256(content).hexdigest(),
            "bytes": len(content),
            "parameters": sum(value.size for value in _weights(0).values()),
            "seed": seed,
            "data": {"seeds": [100], "frames": 1},
            "command": "none: drawn at random",
            **{"hours": None, "scores": None},
        }
        (folder / f"{name}.json").write_text(json.dumps(card))


def record_driver(folder: Path, count: int) -> Path:
    """Record frames of noise for it, in one scene."""
    random = np.random.default_rng(2)
    frames = [
        {
            "img": random.normal(size=(1, 6, 3, 16, 24)).astype(np.float32),
            "lidar2img": random.normal(size=(1, 6, 4, 4)).astype(np.float32),
            "can_bus": random.normal(size=18).astype(np.float32),
            "command": np.array([index % 6]),
            "timestamp": np.array([0.5 * index], np.float32),
        }
        for index in range(count)
    ]
    return record(folder, frames)


def _weights(seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        drawn: np.ndarray = random.normal(size=shape) / np.sqrt(shape[0])
        return drawn.astype(np.float32)

    ahead = np.array([[2.0 * k, 0.0] for k in range(1, 7)], np.float32)
    return {
        "backbone.weight": draw(18, 16),
        "neck.weight": draw(16, WIDTH),
        "bev_encoder.shape": np.array([1, 18]),
        "bev_encoder.weight": draw(18, WIDTH) * np.float32(0.1),
        "bev_encoder.decay": np.array(0.5, np.float32),
        "track.weight": draw(WIDTH, WIDTH),
        **{f"{name}.weight": draw(WIDTH, WIDTH) for name in ("map", "motion", "occ")},
        "planner.row": np.array([1, 1]),
        "planner.weight": draw(4 * WIDTH + 3, 12) * np.float32(0.1),
        "planner.shape": np.array([1, 6, 2]),
        "planner.ahead": ahead[None],
    }


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a small driver, in the place of the package's."""
    write_shipped(tmp_path / "weights")
    monkeypatch.setattr(drivers, "WEIGHTS", tmp_path / "weights")
    return tmp_path / "weights"
