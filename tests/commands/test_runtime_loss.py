"""The loss that is told is the file's; what onnxruntime answers otherwise is apart."""

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from tests.support.frames import record
from tests.support.nets import net

DEAD = """
net (float[1,32,8,8] x, float[32,32,3,3] first, float[32] b, float[32,32,1,1] second)
    => (float[1,32,8,8] y) {
    c = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(x, first, b)
    r = Relu(c)
    y = Conv<kernel_shape=[1,1]>(r, second)
}
"""


def as_written(path: Path, frame: dict[str, Any]) -> np.ndarray:
    """Run the nodes of a file as they stand, without any code of ours."""
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    (answer,) = session.run(["y"], frame)
    return np.asarray(answer, np.float64)


@pytest.mark.parametrize("target", ["tensorrt", "onnxruntime"])
@pytest.mark.parametrize("seed", range(3))
def test_the_loss_that_is_told_is_that_of_the_nodes(
    tmp_path: Path, target: str, seed: int
) -> None:
    """Weights near the ends of int8 overflow 16 bits; a dead channel's bias int32."""
    random = np.random.default_rng(seed)
    first = np.sign(random.normal(size=(32, 32, 3, 3))) * random.uniform(0.15, 0.2)
    first[:, :, 0] += random.normal(0, 0.05, (32, 32, 3))
    first[::8] *= 1e-11
    weights = {"first": first, "b": random.normal(size=32) + 1}
    weights["second"] = random.normal(0, 0.2, (32, 32, 1, 1))
    model = net(DEAD, weights)
    for node in model.graph:
        node.metadata_props.clear()  # modules are those of any graph
    graph.save(model, tmp_path / "in.onnx")
    frames = [
        {"x": random.normal(size=(1, 32, 8, 8)).astype(np.float32)} for _ in range(8)
    ]
    record(tmp_path / "frames", frames)
    options = me2e.CompressOptions(scheme="full", rules="paper", target=target)

    made = me2e.compress(
        tmp_path / "in.onnx", tmp_path / "out.onnx",
        frames=tmp_path / "frames", options=options,
    )  # fmt: skip

    assert made.loss is not None
    assert made.loss.fidelity is not None
    (told,) = made.loss.fidelity.outputs
    measured = [frames[place] for place in (1, 4, 6)]
    assert made.loss.fidelity.frames == len(measured)
    pairs = [
        tuple(as_written(tmp_path / name, frame) for name in ("in.onnx", "out.onnx"))
        for frame in measured
    ]
    noise = sum(float(np.square(a - b).sum()) for a, b in pairs)
    signal = sum(float(np.square(a).sum()) for a, _ in pairs)
    assert told.sqnr_db == pytest.approx(10 * np.log10(signal / noise), abs=0.5)
    assert told.sqnr_db > 25
    # such sums overflow where the processor has no VNNI, and that is the cause then
    apart = made.loss.runtime
    if target == "onnxruntime" and apart is not None and apart.sqnr_db:
        assert "overflow 16 bits on this processor" in " ".join(apart.causes)
