"""A calibrated graph: what int8 costs its nodes by the estimate, and measured."""

import dataclasses
from pathlib import Path

import numpy as np
import onnx_ir as ir

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.fidelity.compare import Reference
from me2e_compress.graph import static_shape
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.plan import FLOAT, QuantPlan
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity import estimate as room
from me2e_compress.sensitivity.error_sources import blamed
from me2e_compress.sensitivity.estimate import NodeCost, estimate
from me2e_compress.targets import TARGETS, Target
from tests.frames import record
from tests.nets import MODULES, net

HEAD = '<ir_version: 9, opset_import: ["" : 17]>\n'
BLOCK = (
    HEAD
    + """
net (float[1,3,16,16] image, float[16,3,3,3] w0, float[16,16,3,3] w1,
     float[16,16,1,1] w2, float[16,8] w3) => (float[1,16,4,4] small, float[1,256,8] y)
    <int64[3] tokens = {1, 16, 256}> {
    ["/backbone/stem"] a = Conv<pads=[1,1,1,1]>(image, w0)
    ["/backbone/Relu"] r = Relu(a)
    ["/backbone/main"] b = Conv<pads=[1,1,1,1]>(r, w1)
    ["/backbone/shortcut"] s = Conv(r, w2)
    ["/backbone/Add"] sum = Add(b, s)
    ["/backbone/Pool"] small = MaxPool<kernel_shape=[4,4], strides=[4,4]>(sum)
    ["/head/Reshape"] flat = Reshape(sum, tokens)
    ["/head/Transpose"] rows = Transpose<perm=[0,2,1]>(flat)
    ["/head/Linear"] l = MatMul(rows, w3)
    ["/head/Tanh"] y = Tanh(l)
}"""
)


def block(outlier: float = 0.0) -> ir.Model:
    """A residual block and a head; the head's weight may have an outlier."""
    random = np.random.default_rng(0)
    shapes = ((16, 3, 3, 3), (16, 16, 3, 3), (16, 16, 1, 1), (16, 8))
    weights = {f"w{at}": random.normal(0, 0.2, each) for at, each in enumerate(shapes)}
    weights["w3"][0] += outlier
    weights["w1"][0] *= 1e-3 if outlier else 1
    weights["w2"][0] *= 1e-3 if outlier else 1
    return net(BLOCK, weights)


@dataclasses.dataclass(frozen=True)
class Case:
    """A calibrated graph with its plan."""

    model: ir.Model
    plan: QuantPlan
    target: Target
    frames: CalibrationSet

    @classmethod
    def of(cls, folder: Path, model: ir.Model, target: str = "tensorrt") -> "Case":
        random, place = np.random.default_rng(1), TARGETS.parse(target)
        shapes = {str(v.name): static_shape(v) for v in model.graph.inputs}
        drawn = [
            {n: random.standard_normal(s).astype("f") for n, s in shapes.items()}
            for _ in range(6)
        ]
        frames = CalibrationSet(record(folder / "frames", drawn))
        plan = QuantizeInt8(rules="paper", target=target).plan(model, Context(MODULES))
        kept = place.kept_float(plan, model)
        return cls(model, dataclasses.replace(plan, kept_float=kept), place, frames)

    @property
    def ranges(self) -> Ranges:
        """Calibrate."""
        tensors = self.target.tensors(self.plan, self.model)
        return Calibrator(threads=1).run(self.model, tensors, self.frames)

    def told(
        self, seed: int = 0, most_held: int = room.MOST_HELD
    ) -> dict[str, NodeCost]:
        """Estimate, by node."""
        grids = self.target.grids(self.plan, self.model, self.ranges)
        costs = estimate(
            self.model,
            self.plan,
            grids,
            self.frames,
            seed=seed,
            threads=1,
            most_held=most_held,
        )
        return {each.node: each for each in costs}

    def measured(self, node: str) -> dict[str, float]:
        """Make one node int8, with the residual Add behind it."""
        nodes = {str(n.outputs[0].name): n for n in self.model.graph}
        (output,) = (e.output for e in self.plan.decisions if e.node == node)
        decisions = tuple(
            each
            if blamed(nodes[each.output], each) == output
            else dataclasses.replace(each, dtype=FLOAT, activations=(), weight=None)
            for each in self.plan.decisions
        )
        plan = dataclasses.replace(self.plan, decisions=decisions, groups=())
        made = self.target.place(self.model, plan, self.ranges)
        reference = Reference.of(Session(self.model, threads=1), self.frames)
        found = reference.compare(Session(made, threads=1)).outputs
        return {each.name: 10 ** (-each.sqnr_db / 20) for each in found}
