"""Small graphs with modules, for tests of calibration, targets and passes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.provenance import Provenance
from me2e_compress.quantization.decision import Decision, QuantPlan, QuantScheme
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.rules.rule_sets import PaperRules
from me2e_compress.runtime.frames import Frame
from me2e_compress.targets import TARGETS

PAPER = PaperRules()
"""Rules under which graphs as small as these have int8: no kernel is asked."""

CONV_ATTENTION = """
<ir_version: 9, opset_import: ["" : 17]>
net (float[1,3,8,8] image, float[1,8,64] memory,
     float[8,3,3,3] w, float[8] b, float[8,8] l, float[] half)
    => (float[1,64,8] y, float[1,8,64] memory_out) <int64[3] tokens = {1, 8, 64}> {
    ["/backbone/Conv"] a = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(image, w, b)
    ["/backbone/Relu"] r = Relu(a)
    ["/backbone/Reshape"] flat = Reshape(r, tokens)
    ["/head/Add"] seen = Add(flat, memory)
    ["/head/Transpose"] q = Transpose<perm=[0,2,1]>(seen)
    ["/head/QK"] scores = MatMul(q, seen)
    ["/head/Softmax"] p = Softmax<axis=-1>(scores)
    ["/head/AV"] mixed = MatMul(p, q)
    ["/head/Linear"] y = MatMul(mixed, l)
    ["/head/Mul"] memory_out = Mul(seen, half)
}
"""


DRIVER = """
<ir_version: 9, opset_import: ["" : 17]>
driver (float[1,4] camera) => (float[1,4] plan) {
    ["/backbone/Relu"] features = Relu(camera)
    ["/occ_head/Sigmoid"] occupancy = Sigmoid(features)
    ["/plan_head/Add"] plan = Add(features, occupancy)
}
"""

DRIVER_MAP = """
[modules.backbone]
role = "feature"
optional = ["backbone"]
[modules.occ]
role = "prediction"
optional = ["occ_head"]
[modules.planner]
role = "prediction"
optional = ["plan_head"]
"""


def map_text(**roles: str) -> str:
    """Write a map of modules, each of the nodes below its own name."""
    return "".join(
        f'[modules.{name}]\nrole = "{role}"\npatterns = ["{name}"]\n'
        for name, role in roles.items()
    )


MAP_TEXT = map_text(backbone="feature", head="prediction")
MODULES = ModuleMap.parse(MAP_TEXT, "net")

FULL = QuantScheme.named("full", MODULES)


def conv_attention(seed: int = 0) -> ir.Model:
    """A convolution, an attention of 64 tokens, a linear layer and a memory."""
    generator = np.random.default_rng(seed)
    shapes = {"w": (8, 3, 3, 3), "b": (8,), "l": (8, 8)}
    weights = {n: generator.standard_normal(shape) for n, shape in shapes.items()}
    return net(CONV_ATTENTION, {**weights, "half": np.array(0.5)})


def parsed(text: str) -> ir.Model:
    """Read a graph, of opset 17 where it names none."""
    named = text.lstrip().startswith("<")
    head = "" if named else '<ir_version: 9, opset_import: ["" : 17]>'
    return ir.from_onnx_text(head + text)


def stored(model: ir.Model, weights: Mapping[str, npt.NDArray[Any]]) -> ir.Model:
    """Make weights of some inputs."""
    for value in list(model.graph.inputs):
        if (name := str(value.name)) in weights:
            model.graph.inputs.remove(value)
            value.const_value = ir.tensor(weights[name], name=name)
            model.graph.register_initializer(value)
    return model


def net(text: str, weights: Mapping[str, npt.NDArray[np.floating]]) -> ir.Model:
    """Read a graph, make weights of some inputs, stamp modules, infer shapes.

    A node belongs to the module that its name begins with, else to ``head``.
    """
    floats = {name: array.astype(np.float32) for name, array in weights.items()}
    model = stored(parsed(text), floats)
    for node in model.graph.all_nodes():
        name = node.name or ""
        module = name.split("/")[1] if name.startswith("/") else "head"
        provenance.stamp(node, Provenance(module, (name,)))
    graph.infer_shapes(model)
    return model


def drawn(text: str, shapes: Mapping[str, tuple[int, ...]], seed: int = 0) -> ir.Model:
    """Read a graph whose weights are normal numbers."""
    generator = np.random.default_rng(seed)
    return net(text, {n: generator.standard_normal(s) for n, s in shapes.items()})


def placed(
    model: ir.Model,
    target: str = "tensorrt",
    rules: str = "paper",
    scheme: QuantScheme = FULL,
    ends: tuple[float, float] = (-3.0, 3.0),
) -> ir.Model:
    """Place a plan, every tensor of one range."""
    chosen = TARGETS.parse(target)
    plan = make_plan(model, scheme, RULE_SETS.parse(rules))
    ranges = dict.fromkeys(chosen.tensors(plan, model), ends)
    return chosen.place(model, plan, Ranges(ranges, "max-min", 1, "", ""))


def planned(model: ir.Model, rules: str = "safe") -> QuantPlan:
    """Plan the module ``head`` in int8, by a set of rules."""
    scheme = QuantScheme.of(("head",), MODULES)
    return make_plan(model, scheme, RULE_SETS.parse(rules))


def by_output(plan: QuantPlan) -> dict[str, Decision]:
    """Map the output of every layer to what was decided of it."""
    return {each.output: each for each in plan.decisions}


def save_text(path: Path, text: str, **metadata: str) -> Path:
    """Write a graph, of opset 17 where its text names none."""
    model = parsed(text)
    model.metadata_props.update(metadata)
    graph.save(model, path)
    return path


def image(seed: int) -> dict[str, npt.NDArray[np.float32]]:
    """One input of :func:`conv_attention`, its memory left out."""
    array = np.random.default_rng(seed).standard_normal((1, 3, 8, 8))
    return {"image": array.astype(np.float32)}


def image_frames() -> list[Frame]:
    """Give one scene of two frames of :func:`conv_attention`, its memory left out."""
    return [Frame(at, at == 0, dict(image(at))) for at in range(2)]


def turn_softmax(model: ir.Model) -> None:
    """Break :func:`conv_attention`: its attention is shared along another axis."""
    model.graph.node("/head/Softmax").attributes["axis"] = ir.AttrInt64("axis", 1)
