"""GridSample of feature maps as deformable attention: one head, one point, weight 1.

Given:   Reshape(Transpose(rows [H W, C])) -> GridSample -> Reshape -> Transpose

Result:  Reshape -> me2e::MultiScaleDeformableAttention -> Reshape, on the rows

onnxruntime's CPU reads a map channel by channel; the kernel reads all channels of a
pixel at once, which must be contiguous. BEVFormer stores its bird's-eye view so, and
transposes it only to rotate it. Nearest samples are bilinear ones at rounded positions.
"""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import (
    VIEWS,
    is_standard,
    maker,
    permutation_of,
    sole_reader,
)
from me2e_compress.graph.rewrite import replace_value
from me2e_compress.operators import OWN_DOMAIN, FusedCall

# Fewer do not fill one vector of 512 bits of float32.
LEAST_CHANNELS = 16

_BILINEAR, _NEAREST = ("bilinear", "linear"), "nearest"

# Nanoseconds to start, for each point, and for each number that is sampled: of
# GridSample and of the kernel, with the nodes that prepare its positions
_NODES = {True: (4_100, 0, 7.2), False: (3_700, 11.5, 1.95)}  # nearest or bilinear
_KERNEL = {True: (7_200, 72, 0.75), False: (5_700, 40, 0.73)}

_TURN = 0.3  # nanoseconds for each number that a Transpose moves


@dataclasses.dataclass(frozen=True)
class _Sizes:
    """Of the image [N, C, H, W] and of the grid [N, F, G, 2]."""

    batch: int
    channels: int
    height: int
    width: int
    grid: tuple[int, ...]

    @property
    def points(self) -> int:
        return self.grid[1] * self.grid[2]


def fuse_grid_sample(node: ir.Node, call: FusedCall) -> ir.Value | None:
    """Write a GridSample with constant sizes as deformable attention; [N, C, F, G]."""
    image, grid = node.inputs[:2]
    if image is None or grid is None:
        return None
    # Check attributes, sizes and what it gains
    mode, sizes = _checked(node, image, grid)
    rows = _source_rows(image, sizes)
    turned = _turned_readers(node.outputs[0], sizes)
    if mode != _NEAREST and rows is None and not turned:
        raise PreconditionError("bilinear, and channels are not side by side")
    saved = rows is not None and sole_reader(image) is not None
    if not pays(mode, sizes, (saved, bool(turned)), (rows is None, not turned)):
        map_ = f"{sizes.channels} channels of {sizes.height} x {sizes.width}"
        raise PreconditionError(f"its nodes are as fast: {map_}, {sizes.points} points")
    # Sample rows of channels
    n, channels = sizes.batch, sizes.channels
    if rows is None:
        whole = call.reshape(image, (n, channels, -1))
        rows = call.transpose(whole, (0, 2, 1))
    value = call.reshape(rows, (n, sizes.height * sizes.width, 1, channels))
    at = _locations(call, grid, mode, sizes)
    ones = np.ones((n, sizes.points, 1, 1, 1))
    maps = call.sizes((sizes.height, sizes.width), (1, 2)), call.integers([0])
    inputs = [value, *maps, at, call.numbers(ones, value)]
    sampled = call.add("MultiScaleDeformableAttention", inputs, domain=OWN_DOMAIN)
    sampled.type, sampled.shape = value.type, ir.Shape((n, sizes.points, 1, channels))
    # Readers that turn channels to the last axis read the rows as they are
    for reader in turned:
        shape = static_shape(reader.outputs[0]) or ()
        replace_value(reader.outputs[0], call.reshape(sampled, shape))
    result = call.reshape(sampled, (n, sizes.points, channels))
    result = call.transpose(result, (0, 2, 1))
    return call.reshape(result, (n, channels, *sizes.grid[1:3]))


def pays(
    mode: str, sizes: _Sizes, saved: tuple[bool, bool], added: tuple[bool, bool]
) -> bool:
    """Return whether the kernel is faster than the nodes.

    ``saved`` and ``added`` are whether it saves, or needs, a Transpose of the map and
    one of the samples. The constants were fitted to 341 shapes on one core of an AMD
    EPYC (Zen 4; ``benchmarks.measure.fusions``): 16 to 256 channels, maps of 8 to 100 a
    side, 1 to 10,000 points.
    """
    pixels, count = sizes.height * sizes.width, sizes.batch * sizes.channels

    def cost(costs: tuple[float, float, float], turns: tuple[bool, bool]) -> float:
        start, point, number = costs
        turned = turns[0] * pixels + turns[1] * sizes.points
        sampled = sizes.batch * point + number * count
        return start + sampled * sizes.points + _TURN * count * turned

    is_nearest = mode == _NEAREST
    return cost(_KERNEL[is_nearest], added) < cost(_NODES[is_nearest], saved)


def _checked(node: ir.Node, image: ir.Value, grid: ir.Value) -> tuple[str, _Sizes]:
    """Return how it samples, and its sizes; refuse what the kernel cannot do."""
    # Attributes that deformable attention has, too
    mode = node.attributes.get_string("mode", "bilinear")
    padding = node.attributes.get_string("padding_mode", "zeros")
    problems = {
        f"it samples {mode}": mode not in (*_BILINEAR, _NEAREST),
        f"it pads with {padding}, not zeros": padding != "zeros",
        "it aligns corners": node.attributes.get_int("align_corners", 0),
    }
    for problem, is_there in problems.items():
        if is_there:
            raise PreconditionError(problem)
    # Image [N, C, H, W] and grid [N, F, G, 2]
    map_, places = static_shape(image), static_shape(grid)
    if map_ is None or places is None or len(map_) != 4 or 0 in (*map_, *places):
        raise PreconditionError("sizes are unknown, or it samples a volume")
    if {image.dtype, grid.dtype} != {ir.DataType.FLOAT}:
        raise PreconditionError("it is not of float32")
    if map_[1] < LEAST_CHANNELS:
        raise PreconditionError(f"{map_[1]} channels, below {LEAST_CHANNELS}")
    return mode, _Sizes(*map_, places)


def _source_rows(image: ir.Value, sizes: _Sizes) -> ir.Value | None:
    """Return the value with its channels last that the image is transposed from."""
    value = image
    while (view := maker(value, *VIEWS)) is not None and view.inputs[0] is not None:
        value = view.inputs[0]
    turn = maker(value, "Transpose")
    shape, order = static_shape(value), None if turn is None else permutation_of(turn)
    if turn is None or shape is None or order is None:
        return None
    back = [order.index(axis) for axis in range(len(order))]
    return turn.inputs[0] if _puts_channels_last(shape, back, sizes) else None


def _turned_readers(value: ir.Value, sizes: _Sizes) -> list[ir.Node]:
    """Return the Transposes, behind views, that put the channels last."""
    # Follow views of the result to the Transposes that read them
    readers, waiting = [], [use.node for use in value.uses()]
    while waiting:
        node = waiting.pop()
        source = node.inputs[0]
        if not is_standard(node) or node.graph is not value.graph or source is None:
            continue
        if node.op_type in VIEWS:
            reader = sole_reader(node.outputs[0])
            waiting.extend([] if reader is None else [reader])
        shape, order = static_shape(source), permutation_of(node)
        turns = node.op_type == "Transpose" and shape is not None and order is not None
        if turns and _puts_channels_last(shape or (), order or [], sizes):
            readers.append(node)
    return readers


def _puts_channels_last(shape: tuple[int, ...], order: list[int], s: _Sizes) -> bool:
    """Return whether an order turns a view of [N, C, ...] to one of [N, ..., C]."""
    real = [axis for axis in order if shape[axis] != 1]
    kept = sorted(real)
    lead = kept[:1] if s.batch > 1 else []
    first, *rest = kept[len(lead) :] or [-1]
    if [shape[axis] for axis in lead] != [s.batch] * len(lead):
        return False
    return shape[first] == s.channels and real == [*lead, *rest, first]


def _locations(call: FusedCall, grid: ir.Value, mode: str, s: _Sizes) -> ir.Value:
    """Write the positions -1..1 as 0..1 of the map, [N, Q, 1, 1, 1, 2]."""
    moved = call.add("Add", [grid, call.numbers(1.0, grid)])
    half = call.numbers(0.5, grid)
    if mode != _NEAREST:
        at = call.add("Mul", [moved, half])
    else:
        # In onnxruntime's order, so that ties fall alike
        size = call.numbers(np.array([s.width, s.height]), grid)
        scaled = call.add("Mul", [moved, size])
        pixel = call.add("Sub", [scaled, call.numbers(1.0, grid)])
        pixel = call.add("Round", [call.add("Mul", [pixel, half])])
        at = call.add("Div", [call.add("Add", [pixel, half]), size])
    return call.reshape(at, (s.batch, s.points, 1, 1, 1, 2))
