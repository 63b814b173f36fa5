"""A graph of seven nodes and frames for it, the same on every machine.

The exact passes fold one node (a product of weights) and fuse another (batch
normalization); ``full`` makes both convolutions and the residual addition int8.
"""

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper, parser

TEXT = Path(__file__).with_suffix(".onnxtxt")
SEED = 11


def write_model(path: Path) -> None:
    """Write the graph; every input of the text but the first becomes a weight."""
    model = parser.parse_model(TEXT.read_text(encoding="utf-8"))
    generator = np.random.default_rng(SEED)
    for port in list(model.graph.input)[1:]:
        shape = [size.dim_value for size in port.type.tensor_type.shape.dim]
        values = generator.uniform(0.01, 0.2, shape).astype(np.float32)
        model.graph.initializer.append(numpy_helper.from_array(values, port.name))
        model.graph.input.remove(port)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def write_frames(folder: Path, count: int = 2) -> None:
    """Write a recording of one scene; every frame widens the ranges."""
    folder.mkdir()
    generator = np.random.default_rng(SEED)
    for index in range(count):
        image = (index + 1) * generator.standard_normal((1, 3, 16, 16))
        np.savez(folder / f"{index:06}.npz", image=image.astype(np.float32))
    scenes = json.dumps({"scenes": [0]})
    (folder / "scenes.json").write_text(scenes, encoding="utf-8")
