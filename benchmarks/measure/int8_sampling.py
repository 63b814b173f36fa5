"""What uint8 feature maps, and weights of zero, are worth to deformable attention.

    python -m benchmarks.measure.int8_sampling [--rounds 15]

One node of the toolkit's own operator in our session, sizes of VAD-tiny, on one thread:
CPU milliseconds, the least of rounds that alternate. The maps are an input, or what an
int8 layer gives; float, or quantized in front of the node, whose kernel then reads the
integers. Then the node alone, with the weights of a part of what each query looks at
zero, as those of cameras that do not see it are. Ten CPU seconds.
"""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir

from benchmarks.tools.processes import in_turn
from me2e_compress import graph
from me2e_compress.runtime.session import Session

HEADS, WIDTH = 8, 32
CHANNELS = HEADS * WIDTH
Arrays = Mapping[str, npt.NDArray[Any]]
LAYER = """
    xq = QuantizeLinear(x, step, middle)  xf = DequantizeLinear(xq, step, middle)
    wf = DequantizeLinear<axis=1>(w, ws, wz)
    bf = DequantizeLinear<axis=0>(b, bs, b)
    value = Gemm(xf, wf, bf)"""
CONVOLUTION = """
    xq = QuantizeLinear(x, step, middle)  pixels = Reshape(xq, as_pixels)
    image = Transpose<perm=[0,3,1,2]>(pixels)
    imagef = DequantizeLinear(image, step, middle)
    wf = DequantizeLinear<axis=0>(filter, ws, wz)
    bf = DequantizeLinear<axis=0>(b, bs, b)
    convolved = Conv(imagef, wf, bf)  cq = QuantizeLinear(convolved, step, middle)
    turned = Transpose<perm=[0,2,3,1]>(cq)
    v = DequantizeLinear(turned, step, middle)"""
PAIR = "q = QuantizeLinear(value, step, middle)  v = DequantizeLinear(q, step, middle)"


@dataclasses.dataclass(frozen=True)
class Case:
    """A call of deformable attention: rows of the maps, queries, levels, points."""

    name: str
    rows: int
    queries: int
    levels: int
    points: int

    def model(self, *, layer: bool, pair: bool) -> ir.Model:
        """Write the call, with an int8 layer or a pair in front of it."""
        shape = f"1,{self.queries},{HEADS},{self.levels},{self.points}"
        made = LAYER if layer else "value = Identity(x)"
        read = PAIR if pair else "v = Identity(value)"
        if layer and pair:  # as lowering writes it
            made, read = CONVOLUTION, ""
        text = f"""<ir_version: 8, opset_import: ["" : 17, "me2e" : 1]>
        g (float[{self.rows},{CHANNELS}] x, float[{shape},2] at, float[{shape}] shares)
            => (float[1,{self.queries},{HEADS},{WIDTH}] y) {{
            {made}  {read}
            r = Reshape(v, parted)
            y = me2e.MultiScaleDeformableAttention(r, sizes, starts, at, shares)
        }}"""
        proto = onnx.parser.parse_model(text)
        for name, array in self.constants().items():
            proto.graph.initializer.append(onnx.numpy_helper.from_array(array, name))
        model = ir.from_proto(proto)
        graph.infer_shapes(model)
        return model

    def constants(self) -> Arrays:
        """Return the sizes of square-like maps, and a layer's int8 weights."""
        area = self.rows // self.levels
        height = max(n for n in range(1, int(area**0.5) + 1) if area % n == 0)
        weights = np.random.default_rng(0).integers(-127, 128, (CHANNELS, CHANNELS))
        weights = weights.astype(np.int8)
        return {
            "as_pixels": np.array([1, -1, 1, CHANNELS]),
            "filter": np.ascontiguousarray(weights.T)[:, :, None, None],
            "parted": np.array([1, self.rows, HEADS, WIDTH]),
            "sizes": np.array([[height, area // height]] * self.levels),
            "starts": np.arange(self.levels) * area,
            "step": np.array(0.03, np.float32),
            "middle": np.array(128, np.uint8),
            "w": weights,
            "ws": np.full(CHANNELS, 0.001, np.float32),
            "wz": np.zeros(CHANNELS, np.int8),
            "b": np.zeros(CHANNELS, np.int32),
            "bs": np.full(CHANNELS, 0.00003, np.float32),
        }

    def feeds(self, masked: float = 0.0) -> Arrays:
        """Draw maps, places around each query's own, and weights."""
        random = np.random.default_rng(1)
        side = int(np.ceil(self.queries**0.5))
        line = np.linspace(0, 1, side)
        cells = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)[: self.queries]
        shape = (1, self.queries, HEADS, self.levels, self.points)
        at = cells[None, :, None, None, None] + random.normal(
            scale=0.03, size=(*shape, 2)
        )
        seen = random.uniform(size=(1, self.queries, 1, self.levels, 1)) >= masked
        return {
            "x": random.normal(size=(self.rows, CHANNELS)).astype(np.float32),
            "at": at.astype(np.float32),
            "shares": (random.uniform(size=shape) * seen).astype(np.float32),
        }


CASES = (
    Case("BEV on BEV, two frames", 20_000, 10_000, 2, 4),
    Case("BEV on six cameras", 1_440, 10_000, 6, 8),
    Case("map queries on BEV", 10_000, 2_000, 1, 4),
    Case("objects on BEV", 10_000, 300, 1, 4),
)


def milliseconds(
    sessions: Sequence[Session], feeds: Sequence[Arrays], rounds: int
) -> list[float]:
    """Time runs in turn: the least CPU time of each."""
    pairs = zip(sessions, feeds, strict=True)
    works = {str(at): partial(one.run, fed) for at, (one, fed) in enumerate(pairs)}
    return [min(seconds) * 1e3 for seconds in in_turn(works, rounds).values()]


def show(case: Case, rounds: int) -> None:
    """Print one case: both kinds of maps, and masks."""
    for layer in (False, True):
        sessions = [
            Session(case.model(layer=layer, pair=pair), threads=1, int8_kernels=True)
            for pair in (False, True)
        ]
        plain, small = milliseconds(sessions, [case.feeds()] * 2, rounds)
        made = "an int8 layer" if layer else "an input"
        print(f"{case.name}, maps of {made}: {plain:.2f} ms, uint8 {small:.2f} ms")
    alone = Session(case.model(layer=False, pair=False), threads=1)
    parts = (0.0, 0.5, 0.8)
    taken = milliseconds([alone] * 3, [case.feeds(part) for part in parts], rounds)
    told = ", ".join(f"{p:.0%} {t:.2f} ms" for p, t in zip(parts, taken, strict=True))
    print(f"{case.name}, weights that are zero: {told}", flush=True)


def main() -> None:
    """Parse arguments, show every case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    for case in CASES:
        show(case, rounds)


if __name__ == "__main__":
    main()
