"""Small stacks of several files."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from me2e_compress import graph
from me2e_compress.graph import rewrite
from me2e_compress.graph.stack.join import JoinedStack
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session
from tests.support.frames import record
from tests.support.nets import parsed

BACKBONE = """
backbone (float[1,4] img) => (float[1,4] feats) <float[1] two = {2}>
{ ["/backbone/Mul"] feats = Mul(img, two) }
"""

HEAD = """
head (float[1,4] feats, float[1,4] prev_bev)
    => (float[1,4] next_bev, float[1,2,2] plan)
<float[1] half = {0.5}, int64[3] points = {1,2,2}, float[1,4] learned = {1,2,3,4}> {
    ["/head/Mul"] before = Mul(prev_bev, half)
    ["/head/Add"] next_bev = Add(feats, before)
    ["/head/Sub"] kept = Sub(next_bev, learned)
    ["/head/Reshape"] plan = Reshape(kept, points)
}
"""

TWO_PARTS = """
[[part]]
name = "head"
file = "head.onnx"
[[part]]
name = "backbone"
file = "backbone.onnx"
"""


def write_stack(folder: Path, toml: str = TWO_PARTS, **texts: str) -> Path:
    """Write the two graphs, or others of these names, and a TOML; return that."""
    known = {"backbone": BACKBONE, "head": HEAD}
    for name, text in (known | texts).items():
        graph.save(parsed(text), folder / f"{name}.onnx")
    path = folder / "stack.toml"
    path.write_text(toml)
    return path


def joined(path: Path) -> Session:
    """Open the graph that a stack's files are joined to."""
    return Session(JoinedStack.load(path).model, threads=1, optimize=False)


DENSE = {
    "backbone": """
backbone (float[4,16] img) => (float[4,32] feats)
{ ["/backbone/MatMul"] a = MatMul(img, w) ["/backbone/Relu"] feats = Relu(a) }
""",
    "head": """
head (float[4,32] feats, float[4,32] prev_bev)
    => (float[4,32] next_bev, float[1,64,2] plan) <int64[3] points = {1, 64, 2}> {
    ["/head/Add"] next_bev = Add(feats, prev_bev)
    ["/head/MatMul"] far = MatMul(next_bev, w)
    ["/head/Reshape"] plan = Reshape(far, points)
}
""",
}
"""Parts with a layer to quantize each; ``w`` is drawn."""


def write_dense(folder: Path) -> Path:
    """Write parts that have a layer to quantize; return the TOML."""
    random = np.random.default_rng(0)
    for name, text in DENSE.items():
        model = parsed(text)
        draws = random.normal(size=(16 if name == "backbone" else 32, 32))
        weight = rewrite.add_constant(model.graph, draws.astype(np.float32), "w")
        (layer,) = (node for node in model.graph if node.op_type == "MatMul")
        layer.replace_input_with(1, weight)
        graph.save(model, folder / f"{name}.onnx")
    path = folder / "stack.toml"
    path.write_text(TWO_PARTS)
    return path


def dense_frames(folder: Path) -> Path:
    """Record frames for it: four scenes of two."""
    images = np.random.default_rng(1).normal(size=(8, 4, 16)).astype(np.float32)
    return record(folder / "frames", [{"img": each} for each in images], (0, 2, 4, 6))


def ones(*starts: bool) -> list[Frame]:
    """Return a frame of ones a flag, which says whether a scene begins."""
    image: npt.NDArray[np.float32] = np.ones((1, 4), np.float32)
    return [Frame(at, start, {"img": image}) for at, start in enumerate(starts)]
