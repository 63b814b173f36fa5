"""Draw single nodes with all their attributes, and run them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
from onnx_ir import convenience

from me2e_compress.graph import rewrite
from me2e_compress.runtime.session import Session
from tests.support.nets import parsed
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


def of_node(
    op: str,
    attributes: Mapping[str, Any],
    others: Sequence[object] = (),
    shape: tuple[int, ...] = SHAPE,
) -> ir.Model:
    """Return ``y = op(x, ...)``, other inputs constants or left out (None)."""
    head = '<ir_version: 9, opset_import: ["" : 19]>'
    made = parsed(f"{head} one (float{list(shape)} x) => (float[] y) {{ y = {op}(x) }}")
    node = made.graph[0]
    node.resize_inputs(1 + len(others))
    for at, each in enumerate(others, 1):
        if each is not None:
            constant = rewrite.add_constant(made.graph, np.asarray(each), f"i{at}")
            node.replace_input_with(at, constant)
    for attribute in convenience.convert_attributes(attributes):
        node.attributes.add(attribute)
    return made


def one_node(
    op: str, rng: np.random.Generator, shape: tuple[int, ...] = SHAPE
) -> ir.Model:
    """Draw ``y = op(x, ...)``."""
    return of_node(op, *{**MOVED, **AVERAGED}[op](rng), shape)


def paired(
    model: ir.Model, before: tuple[float, int], behind: tuple[float, int]
) -> ir.Model:
    """Put pairs before and behind the node, on grids of (scale, zero point)."""
    copy = ir.from_proto(ir.to_proto(model))
    node = copy.graph[0]

    def pair(value: ir.Value | None, scale: float, zero: int) -> list[ir.Node]:
        constants = np.asarray(np.float32(scale)), np.asarray(np.uint8(zero))
        grid = [rewrite.add_constant(copy.graph, each, "grid") for each in constants]
        first = ir.node("QuantizeLinear", [value, *grid])
        return [first, ir.node("DequantizeLinear", [first.outputs[0], *grid])]

    fed, answered = pair(node.inputs[0], *before), pair(node.outputs[0], *behind)
    copy.graph.insert_before(node, fed)
    node.replace_input_with(0, fed[1].outputs[0])
    copy.graph.insert_after(node, answered)
    copy.graph.outputs[0] = answered[1].outputs[0]
    copy.graph.outputs[0].type = ir.TensorType(ir.DataType.FLOAT)
    return copy


def answer(model: ir.Model, x: Floats, *, optimize: bool = False) -> Floats:
    """Run in onnxruntime's own int8, if at all in int8."""
    session = Session(model, threads=1, optimize=optimize, stock=True)
    (found,) = session.run({"x": x}).values()
    return np.asarray(found, np.float32)


def on_grid(array: npt.NDArray[np.floating], scale: float, zero: int) -> Floats:
    """Round to a uint8 grid, in float64."""
    steps = np.rint(array.astype(np.float64) / np.float32(scale)) + zero
    return np.asarray((np.clip(steps, 0, 255) - zero) * np.float32(scale), np.float32)
