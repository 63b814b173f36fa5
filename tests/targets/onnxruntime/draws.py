"""Draw single nodes with all their attributes, and run them."""

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from tests.targets.onnxruntime.lowered import Floats

Draw = Callable[[np.random.Generator], tuple[dict[str, object], list[object]]]
"""Attributes, and the inputs behind the first: arrays, or None if left out."""

SHAPE = (2, 4, 6, 8)
PLACES = (
    *("half_pixel", "half_pixel_symmetric", "pytorch_half_pixel", "align_corners"),
    *("asymmetric", "tf_crop_and_resize"),
)
NEAREST = ("round_prefer_floor", "round_prefer_ceil", "floor", "ceil")


def some(rng: np.random.Generator, low: int, high: int, count: int = 2) -> list[int]:
    return [int(number) for number in rng.integers(low, high, count)]


def maybe(rng: np.random.Generator, name: str, value: object) -> dict[str, object]:
    return {name: value} if rng.random() < 0.5 else {}


def pool(rng: np.random.Generator) -> tuple[dict[str, object], list[object]]:
    kernel = some(rng, 1, 4)
    pads = [int(rng.integers(0, size)) for size in (*kernel, *kernel)]
    return {
        "kernel_shape": kernel,
        **maybe(rng, "strides", some(rng, 1, 4)),
        **maybe(rng, "pads", pads),
        **maybe(rng, "ceil_mode", 1),
        **({"dilations": [2, 1]} if rng.random() < 0.2 else {}),
    }, []


def average_pool(rng: np.random.Generator) -> tuple[dict[str, object], list[object]]:
    return {**pool(rng)[0], **maybe(rng, "count_include_pad", 1)}, []


def resize(rng: np.random.Generator) -> tuple[dict[str, object], list[object]]:
    places = str(rng.choice(PLACES))
    crop = places == "tf_crop_and_resize"
    window = [0, 0, *rng.uniform(-0.2, 0.2, 2), 1, 1, *rng.uniform(0.8, 1.3, 2)]
    scales = np.array([1, 1, *rng.uniform(0.4, 2.8, 2)], np.float32)
    return {
        "mode": str(rng.choice(["nearest", "linear", "cubic"], p=[0.8, 0.1, 0.1])),
        "nearest_mode": str(rng.choice(NEAREST)),
        "coordinate_transformation_mode": places,
        "extrapolation_value": -float(rng.uniform(1, 9)),
    }, [np.array(window, np.float32) if crop else None, scales]


def cut(rng: np.random.Generator) -> tuple[dict[str, object], list[object]]:
    starts, ends = some(rng, -6, 6), some(rng, -9, 9)
    steps = [int(rng.choice([-2, -1, 1, 2])) for _ in starts]
    return {}, [np.array(numbers) for numbers in (starts, ends, [1, 3], steps)]


MOVED: Mapping[str, Draw] = {
    "Flatten": lambda rng: ({"axis": int(rng.integers(-4, 5))}, []),
    "MaxPool": pool,
    "Reshape": lambda rng: ({}, [np.array([0, -1, int(rng.choice([1, 2, 4]))])]),
    "Resize": resize,
    "Slice": cut,
    "SpaceToDepth": lambda _: ({"blocksize": 2}, []),
    "Squeeze": lambda _: ({}, []),
    "Transpose": lambda rng: ({"perm": [int(at) for at in rng.permutation(4)]}, []),
    "Unsqueeze": lambda rng: ({}, [np.array(some(rng, 0, 5, 1))]),
}
AVERAGED: Mapping[str, Draw] = {
    "AveragePool": average_pool,
    "GlobalAveragePool": lambda _: ({}, []),
}


def one_node(op: str, rng: np.random.Generator) -> onnx.ModelProto:
    """Draw ``y = op(x, ...)``."""
    attributes, others = {**MOVED, **AVERAGED}[op](rng)
    arrays = {f"i{at}": each for at, each in enumerate(others) if each is not None}
    names = ["" if each is None else f"i{at}" for at, each in enumerate(others)]
    node = helper.make_node(op, ["x", *names], ["y"])
    node.attribute.extend(helper.make_attribute(*each) for each in attributes.items())
    return helper.make_model(
        helper.make_graph(
            [node],
            "one",
            [helper.make_tensor_value_info("x", TensorProto.FLOAT, SHAPE)],
            [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
            [numpy_helper.from_array(np.asarray(a), n) for n, a in arrays.items()],
        ),
        opset_imports=[helper.make_opsetid("", 19)],
        ir_version=9,
    )


def paired(
    model: onnx.ModelProto, before: tuple[float, int], behind: tuple[float, int]
) -> onnx.ModelProto:
    """Put pairs before and behind the node, on grids of (scale, zero point)."""
    (node,), copy = model.graph.node, onnx.ModelProto()
    copy.CopyFrom(model)
    for name, (scale, zero) in (("x", before), ("y", behind)):
        constants = (np.float32(scale), f"{name}_s"), (np.uint8(zero), f"{name}_z")
        copy.graph.initializer.extend(
            numpy_helper.from_array(np.asarray(each), label)
            for each, label in constants
        )
    middle = onnx.NodeProto()
    middle.CopyFrom(node)
    middle.input[0], middle.output[0] = "x_d", "m"
    grids = ["x_s", "x_z"], ["y_s", "y_z"]
    nodes = [
        helper.make_node("QuantizeLinear", ["x", *grids[0]], ["x_q"]),
        helper.make_node("DequantizeLinear", ["x_q", *grids[0]], ["x_d"]),
        middle,
        helper.make_node("QuantizeLinear", ["m", *grids[1]], ["y_q"]),
        helper.make_node("DequantizeLinear", ["y_q", *grids[1]], ["y"]),
    ]
    del copy.graph.node[:]
    copy.graph.node.extend(nodes)
    return copy


def answer(model: onnx.ModelProto, x: Floats, *, optimize: bool = False) -> Floats:
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = 1
    levels = ort.GraphOptimizationLevel
    options.graph_optimization_level = (
        levels.ORT_ENABLE_ALL if optimize else levels.ORT_DISABLE_ALL
    )
    session = ort.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    (found,) = session.run(None, {"x": x})
    return np.asarray(found, np.float32)


def on_grid(array: npt.NDArray[np.floating], scale: float, zero: int) -> Floats:
    """Round to a uint8 grid, in float64."""
    steps = np.rint(array.astype(np.float64) / np.float32(scale)) + zero
    return np.asarray((np.clip(steps, 0, 255) - zero) * np.float32(scale), np.float32)


def node_of(model: onnx.ModelProto) -> ir.Node:
    return next(iter(ir.from_proto(model).graph))
