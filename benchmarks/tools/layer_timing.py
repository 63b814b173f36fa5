"""One layer, or a chain of equal ones, timed in float and in int8 on onnxruntime."""

import dataclasses
from collections.abc import Mapping, Sequence
from statistics import median
from time import perf_counter, process_time

import numpy as np
import onnx
import onnx_ir as ir
from onnx_ir.passes.common import LiftConstantsToInitializersPass

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.provenance import Provenance
from me2e_compress.quantization.costs import CostsOf
from me2e_compress.quantization.decision import QuantPlan, QuantScheme
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session, replay
from me2e_compress.targets.onnxruntime import OnnxRuntime

WHOLE = ModuleMap.whole()
CPU_S = 0.06
"""CPU seconds for a layer and form, at least; five runs in any case."""
MOST_RUNS = 200


@dataclasses.dataclass(frozen=True)
class Layer:
    """A layer with a constant weight, cut out of its graph.

    Attributes:
        op: Conv, MatMul (with the Add of its bias) or Gemm.
        read: shape of what it reads.
        weight: shape of its weight.
        attributes: of a Conv or Gemm, as ONNX text: ``group=1, pads=[1,1,1,1]``.
        bias: whether it has one.
        relu: whether a ReLU follows.
        length: how many of it stand behind each other.
    """

    op: str
    read: tuple[int, ...]
    weight: tuple[int, ...]
    attributes: str = ""
    bias: bool = True
    relu: bool = False
    length: int = 1

    def graph(self) -> ir.Model:
        """Build it with random weights, ``x`` to ``y``, shapes inferred."""
        columns = self.weight[1] if self.op == "MatMul" else self.weight[0]
        if self.op == "Gemm" and "transB=1" not in self.attributes:
            columns = self.weight[1]
        text = (
            '<ir_version: 9, opset_import: ["" : 17]>\n'
            f"layer (float{_dims(self.read)} x, float{_dims(self.weight)} w,"
            f" float[{columns}] b) => (float y) {{\n"
            f"{''.join(self._nodes())}}}"
        )
        return random_model(text)

    def _nodes(self) -> list[str]:
        lines, last = [], "x"
        for step in range(self.length):
            end = "y" if step == self.length - 1 else f"e{step}"
            attributes = f"<{self.attributes}>" if self.attributes else ""
            chain = [f"{self.op}{attributes}({{}}, w)"]
            if self.bias and self.op == "MatMul":
                chain.append("Add({}, b)")
            elif self.bias:
                chain = [f"{self.op}{attributes}({{}}, w, b)"]
            chain += ["Relu({})"] if self.relu else []
            names = [*(f"n{step}_{i}" for i in range(len(chain) - 1)), end]
            for name, call in zip(names, chain, strict=True):
                lines.append(f"{name} = {call.format(last)}\n")
                last = name
        return lines


def random_model(text: str) -> ir.Model:
    """Build a graph whose inputs but the first are weights to draw; infer shapes.

    Weights are normal, divided by the root of how many are summed; vectors are not.
    """
    parsed = onnx.parser.parse_model(text)
    for output in parsed.graph.output:
        output.type.tensor_type.ClearField("shape")
    made = ir.from_proto(onnx.shape_inference.infer_shapes(parsed))
    LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)(made)
    generator = np.random.default_rng(0)
    for value in list(made.graph.inputs)[1:]:
        made.graph.inputs.remove(value)
        shape = graph.static_shape(value) or ()
        array = generator.standard_normal(shape).astype(np.float32)
        columns = array.shape[-1 if array.ndim == 2 else 0]
        fan = max(1.0, float(np.sqrt(array.size / columns)))
        value.const_value = ir.tensor(array / np.float32(fan), name=value.name)
        made.graph.register_initializer(value)
    for place, node in enumerate(made.graph):
        node.name = node.name or f"node {place}"
        past = Provenance(WHOLE.names()[0], (str(node.outputs[0].name),))
        provenance.stamp(node, past)
    return made


def int8_of(model: ir.Model, plan: QuantPlan) -> ir.Model:
    """Quantize a graph for onnxruntime by a plan, every range [-4, 4]."""
    target = OnnxRuntime()
    names = target.tensors(plan, model)
    ranges = Ranges(
        tensors=dict.fromkeys(names, (-4.0, 4.0)),
        frames=1,
        model="",
        source="",
        method="max-min",
    )
    return target.place(model, plan, ranges)


def plan_of(
    model: ir.Model, rules: str = "paper{without=[gemv]}", costs: CostsOf | None = None
) -> QuantPlan:
    """Plan int8 of every layer, whatever it costs, unless other rules are given."""
    scheme = QuantScheme.of(WHOLE.names(), WHOLE)
    return make_plan(model, scheme, RULE_SETS.parse(rules), costs=costs)


@dataclasses.dataclass(frozen=True)
class RunTimes:
    """Times of one model, one for each round; CPU time adds up all threads."""

    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]


def time_interleaved(
    sessions: Mapping[str, Session], frames: Sequence[Frame], rounds: int
) -> dict[str, RunTimes]:
    """Time one frame of every model in turn, A B C A B C, after one uncounted round.

    All models should have the same number of threads. Only the first frame is run, with
    recurrent state at zeros.
    """
    wall: dict[str, list[float]] = {name: [] for name in sessions}
    cpu: dict[str, list[float]] = {name: [] for name in sessions}
    for turn in range(rounds + 1):
        for name, session in sessions.items():
            start, used = perf_counter(), process_time()
            for _ in replay(session, frames[:1]):
                pass
            # The first round only warms up.
            if turn:
                wall[name].append(perf_counter() - start)
                cpu[name].append(process_time() - used)
    return {name: RunTimes(tuple(wall[name]), tuple(cpu[name])) for name in sessions}


def time_both(layer: Layer) -> tuple[float, float]:
    """Return CPU seconds of a layer in float and in int8."""
    model = layer.graph()
    int8 = int8_of(model, plan_of(model))
    taken = time_graphs({"float": model, "int8": int8})
    return taken["float"], taken["int8"]


def time_graphs(graphs: Mapping[str, ir.Model]) -> dict[str, float]:
    """Return CPU seconds of graphs of one input: medians, in turn, one thread."""
    sessions = {
        name: Session(model, threads=1, int8_kernels=True)
        for name, model in graphs.items()
    }
    (value,) = next(iter(graphs.values())).graph.inputs
    shape = graph.static_shape(value) or ()
    array = np.random.default_rng(1).standard_normal(shape).astype(np.float32)
    frames = [Frame(0, starts_scene=True, arrays={str(value.name): array})]
    once = time_interleaved(sessions, frames, 3)
    shortest = min(min(each.cpu_s) for each in once.values())
    runs = int(np.clip(CPU_S / shortest, 5, MOST_RUNS))
    times = time_interleaved(sessions, frames, runs)
    return {name: median(each.cpu_s) for name, each in times.items()}


def _dims(shape: tuple[int, ...]) -> str:
    return f"[{','.join(map(str, shape))}]"
