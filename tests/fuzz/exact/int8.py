"""What quantizing must keep: the graph loads and runs, and without its int8 is itself.

For the target tensorrt, pairs of QuantizeLinear and DequantizeLinear on activations are
taken out again, and every dequantized weight gives way to the float one, from which it
may differ by half a step: what is left must compute what the graph did. For the target
onnxruntime (and ``lower-int8``) weights are permuted, biases are integers and layers
are rewritten, so there only names, shapes, types and finite numbers are checked; how
close the numbers are is a matter of fidelity, not of this test.
"""

import dataclasses
import random
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
from onnx import numpy_helper

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import Me2eError, PassError, VerificationError
from me2e_compress.manager import recipe
from me2e_compress.manager.pass_manager import PassManager
from me2e_compress.passes import Context
from tests.frames import record
from tests.fuzz.exact.judging import MODULES, Case, Verdict, modules_of
from tests.fuzz.exact.running import RefusedError, Runner, drawn_inputs

METHODS = ("max-min", "percentile:99.9", "mse")
SCHEMES = ("full", "full", "feature-ext", "prediction")
RULES = ("paper", "paper", "safe")
EACH = 2
"""How many ways a graph is quantized."""

FRAMES = 2


def ways(seed: int, *, named: bool) -> Iterator[str]:
    """Draw how a graph is quantized: pipelines for each target.

    Args:
        seed: of the drawing.
        named: whether the graph has modules, by which schemes go.
    """
    draw = random.Random(seed)
    for target in ("tensorrt", "onnxruntime", "lowered"):
        for _ in range(EACH):
            options = {
                "scheme": draw.choice(SCHEMES) if named else "full",
                "method": draw.choice(METHODS),
                "rules": draw.choice(RULES),
                "target": "onnxruntime" if target == "onnxruntime" else "tensorrt",
            }
            given = ", ".join(f"{key}={value}" for key, value in options.items())
            text = f"quantize-int8{{{given}}}"
            if target == "lowered":
                text += ", lower-int8"
            yield text


def judged(seed: int, model: onnx.ModelProto) -> Iterator[Verdict]:
    """Judge a drawn graph by all of these."""
    try:
        case = Case(model, seed)
    except RefusedError:
        return
    named = modules_of(model) is MODULES
    for text in ways(seed, named=named):
        yield judge_int8(case, text, seed)


def judge_int8(case: Case, pipeline: str, seed: int) -> Verdict:
    """Fold constants, quantize, and hold the result to what the module says."""
    runner = case.answers.runner
    size = case.sizes[0]
    fed = [drawn_inputs(runner, seed + turn, size) for turn in range(FRAMES)]
    try:
        with tempfile.TemporaryDirectory(prefix="int8-") as folder:
            frames = CalibrationSet(record(Path(folder, "frames"), fed))
            context = dataclasses.replace(case.context, frames=frames, measured={})
            base = _run("fold-constants", case.imported, context)
            after = _run(pipeline, base, context)
    except (PassError, VerificationError) as error:
        return Verdict("crash", pipeline, str(error))
    except Me2eError as error:
        return Verdict("refused", pipeline, str(error))
    except Exception as error:  # the judge must outlive whatever is raised
        return Verdict("crash", pipeline, f"{type(error).__name__}: {error}")
    return _verdict(case, pipeline, base, after)


def _run(pipeline: str, model: ir.Model, context: Context) -> ir.Model:
    passes = recipe.parse(pipeline)
    return PassManager(passes, verify_frames=0).run(model, context).model


def _verdict(case: Case, pipeline: str, base: ir.Model, after: ir.Model) -> Verdict:
    written = ir.to_proto(after)
    if not any(node.op_type == "DequantizeLinear" for node in written.graph.node):
        return Verdict("unchanged", pipeline)
    try:
        onnx.checker.check_model(written)
        found = Runner(written).run(case.answers.feeds[0])
    except (RefusedError, onnx.checker.ValidationError) as error:
        return Verdict("does-not-load", pipeline, str(error))
    if said := _unlike(case.answers.values[0], found):
        return Verdict("wrong", pipeline, said)
    if "target=tensorrt" not in pipeline or "lower-int8" in pipeline:
        return Verdict("right", pipeline)
    return _without_int8(case, pipeline, written, _weights(ir.to_proto(base)))


def _weights(model: onnx.ModelProto) -> list[npt.NDArray[Any]]:
    """List the constants of a graph: a node holds one that is an output as well."""
    nodes = [
        attribute.t
        for node in model.graph.node
        if node.op_type == "Constant"
        for attribute in node.attribute
        if attribute.name == "value"
    ]
    return [numpy_helper.to_array(each) for each in (*model.graph.initializer, *nodes)]


def _without_int8(
    case: Case,
    pipeline: str,
    written: onnx.ModelProto,
    weights: Sequence[npt.NDArray[Any]],
) -> Verdict:
    """Take int8 out again and compare with the graph as drawn."""
    try:
        most = HALF if "rules=paper" in pipeline else WHOLE
        plain = stripped(written, weights, most)
    except StrippingError as error:
        return Verdict("wrong", pipeline, str(error))
    try:
        answers = Runner(plain).run(case.answers.feeds[0])
    except RefusedError as error:
        return Verdict("does-not-load", pipeline, f"without int8: {error}")
    gaps = case.answers.off(0, answers)
    if not gaps:
        return Verdict("right", pipeline)
    steady = case.answers.is_steady(0, gaps)
    said = f"without int8 it is off by {max(gaps.values()):.3g}"
    return Verdict("wrong" if steady else "unstable", pipeline, said)


def _unlike(
    wanted: Mapping[str, npt.NDArray[Any]], found: Mapping[str, npt.NDArray[Any]]
) -> str:
    """Say what is wrong with the form of the outputs; empty if nothing is."""
    if list(wanted) != list(found):
        return f"outputs {list(wanted)} became {list(found)}"
    for name, value in wanted.items():
        other = found[name]
        if (value.shape, value.dtype) != (other.shape, other.dtype):
            return (
                f"{name} {value.dtype}{value.shape} became {other.dtype}{other.shape}"
            )
        whole = value.dtype.kind == "f" and np.isfinite(value).all()
        if whole and not np.isfinite(other).all():
            return f"{name} is no longer finite"
    return ""


HALF = 0.5 * (1 + 1e-4)
"""How many steps a weight may be off; its scale is a rounded number itself."""
WHOLE = 2 * HALF
"""The same of rules that round so that errors cancel."""


class StrippingError(Exception):
    """A weight is none of the float graph's, to the steps that it may be off."""


def stripped(
    model: onnx.ModelProto, weights: Sequence[npt.NDArray[Any]], most: float = HALF
) -> onnx.ModelProto:
    """Take every QuantizeLinear and DequantizeLinear out.

    Args:
        model: quantized for TensorRT.
        weights: those of the float graph.
        most: steps that a weight may be off.

    Raises:
        StrippingError: a weight is none of these.
    """
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    held = {each.name: numpy_helper.to_array(each) for each in copy.graph.initializer}
    source = {
        node.output[0]: node.input[0]
        for node in copy.graph.node
        if node.op_type == "QuantizeLinear"
    }
    for node in copy.graph.node:
        if node.op_type != "DequantizeLinear":
            continue
        if node.input[0] in source:
            _become(node, "Identity", [source[node.input[0]]])
            continue
        name = f"{node.output[0]}__float"
        original = _original(node, held, weights, most)
        copy.graph.initializer.append(numpy_helper.from_array(original, name))
        _become(node, "Identity", [name])
    kept = [node for node in copy.graph.node if node.op_type != "QuantizeLinear"]
    del copy.graph.node[:]
    copy.graph.node.extend(kept)
    return copy


def _become(node: onnx.NodeProto, kind: str, inputs: Sequence[str]) -> None:
    node.op_type = kind
    del node.input[:]
    node.input.extend(inputs)
    del node.attribute[:]


def _original(
    node: onnx.NodeProto,
    held: Mapping[str, npt.NDArray[Any]],
    weights: Sequence[npt.NDArray[Any]],
    most: float,
) -> npt.NDArray[Any]:
    """Find the float weight that an integer one stands for."""
    if node.input[0] not in held:
        raise StrippingError(f"{node.output[0]} dequantizes what nobody quantized")
    integers, scale = held[node.input[0]], held[node.input[1]]
    axis = next((each.i for each in node.attribute if each.name == "axis"), 1)
    if scale.ndim == 1 and integers.ndim:
        shape = [1] * integers.ndim
        shape[axis] = -1
        scale = scale.reshape(shape)
    found = integers.astype(np.float64) * scale.astype(np.float64)
    best = np.inf
    for weight in weights:
        for each in (weight, weight.T):
            if each.dtype.kind != "f" or each.size != found.size:
                continue
            if each.squeeze().shape != found.squeeze().shape:
                continue
            array = each.reshape(found.shape)
            off = np.abs(array - found) / scale
            if off.size == 0 or off.max() <= most:
                return np.asarray(array, scale.dtype)
            best = min(best, float(off.max()))
    raise StrippingError(
        f"{node.output[0]}: a weight {list(integers.shape)} is {best:.3g} steps off"
    )
