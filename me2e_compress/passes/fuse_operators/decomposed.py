"""Find deformable attention that is written in standard operators.

Zhu et al., Deformable DETR, 2021, equation 3, as exporters write it: a GridSample of
each level's feature map, the levels joined, a product with the attention weights, and a
sum over points and levels.
"""

import dataclasses
import math

import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import is_standard, static_shape
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, integers_at, maker, sole_reader
from me2e_compress.passes.digits import Digit, Digits, flat, whole
from me2e_compress.passes.fuse_operators.views import View, aligned, results

BATCH, CHANNEL, LEVEL, PIXEL, XY = "batch", "channel", "level", "pixel", "xy"
# The axes of the samples; rows and columns are those of GridSample's output.
ROW, COLUMN = "row", "column"

SAMPLING = {
    "mode": ("bilinear", "linear"),  # from opset 20 on it is called linear
    "padding_mode": ("zeros",),
}


@dataclasses.dataclass(frozen=True)
class Level:
    """One feature map and where it is sampled."""

    node: ir.Node
    image: View  # [batch * heads, channels, height, width]
    grid: View  # [batch * heads, rows, columns, 2], where -1 and 1 are the edges
    size: tuple[int, int]  # height and width

    @property
    def pixels(self) -> int:
        """The number of pixels of the feature map."""
        return math.prod(self.size)


@dataclasses.dataclass(frozen=True)
class Decomposed:
    """A deformable attention in standard operators."""

    levels: tuple[Level, ...]  # feature maps, in the order in which they are joined
    weights: View
    results: tuple[View, ...]  # the sum, and its layouts; each may be replaced
    queries: Digits  # of rows and columns, those that remain after the sum
    points: Digits  # those that are summed over, without the level
    batch: int  # images times heads
    channels: int
    mask: View | None = None  # factor of each image's results before they are added
    images: Digits = ()  # of the batch, those then added up: cameras or frames
    scale: float = 1.0  # factor of that sum, 1 / count for a mean


def find(node: ir.Node) -> Decomposed:
    """Find the deformable attention of a GridSample, or raise a PreconditionError."""
    # Follow samples, weights and sum
    levels, samples = _levels(node)
    product, weights = _weighted(samples)
    total, _ = _total(list(results(product))[-1], ("ReduceSum",))
    left, before = flat(total.layout), flat(product.layout)
    # Only rows, columns and levels may be summed over
    gone = tuple(digit for digit in before if digit not in left)
    if any(digit.axis in (BATCH, CHANNEL) for digit in gone):
        raise PreconditionError("the sum is over channels or heads too")
    if any(digit.axis == LEVEL for digit in left):
        raise PreconditionError("the levels are not summed over")
    # What remains of rows and columns are queries
    queries, points = (
        tuple(digit for digit in digits if digit.axis in (ROW, COLUMN))
        for digits in (left, gone)
    )
    batch, channels, *_ = static_shape(levels[0].image.value) or (0, 0)
    ends = tuple(results(total))
    return Decomposed(levels, weights, ends, queries, points, batch, channels)


def with_images(decomposed: Decomposed) -> Decomposed:
    """Include a sum or mean over images that follows, masked or not, if there is one.

    Each image becomes one more level. BEVFormer (Li et al., 2022) adds up the cameras
    that see a pillar and takes the mean over this frame and the last.
    """
    # An optional mask, then the sum or mean
    end, mask = decomposed.results[-1], None
    node = sole_reader(end.value)
    try:
        if node is not None and node.op_type == "Mul":
            product, mask = _weighted(end)
            end = list(results(product))[-1]
        total, mean = _total(end, ("ReduceSum", "ReduceMean"))
    except PreconditionError:
        return decomposed
    # Only axes of the batch may be summed over
    left = flat(total.layout)
    gone = tuple(digit for digit in flat(end.layout) if digit not in left)
    if not gone or any(digit.axis != BATCH for digit in gone):
        return decomposed
    count = math.prod(digit.size for digit in gone)
    return dataclasses.replace(
        decomposed,
        results=tuple(results(total)),
        mask=mask,
        images=gone,
        scale=1 / count if mean else 1.0,
    )


def _level(node: ir.Node) -> tuple[Level, View]:
    """Describe a GridSample and the layout of its output, or raise why it cannot be."""
    for name, allowed in SAMPLING.items():
        mode = node.attributes.get_string(name, allowed[0])
        if mode not in allowed:
            raise PreconditionError(f"it samples with {name}={mode}")
    if node.attributes.get_int("align_corners", 0):
        raise PreconditionError("it samples with align_corners=1")
    # Shapes and types must be known and supported
    image, grid = node.inputs[0], node.inputs[1]
    shape, places = static_shape(image), static_shape(grid)
    if image is None or grid is None or shape is None or places is None:
        raise PreconditionError(
            "its shapes are not known: run fold-constants first, open dimensions fixed"
        )
    if len(shape) != 4:
        raise PreconditionError("it samples in three dimensions")
    if {image.dtype, grid.dtype} != {ir.DataType.FLOAT}:
        raise PreconditionError("it samples in another type than float32")
    # Describe both operands by their digits
    batch, channels, height, width = shape
    row = (Digit(PIXEL, width, height),) if height > 1 else ()
    first, second = whole(BATCH, batch), whole(CHANNEL, channels)
    rows, columns = whole(ROW, places[1]), whole(COLUMN, places[2])
    maps = View(image, (first, second, row, whole(PIXEL, width)))
    at = View(grid, (first, rows, columns, whole(XY, 2)))
    level = Level(node, maps, at, (height, width))
    return level, View(node.outputs[0], (first, second, rows, columns))


def _levels(node: ir.Node) -> tuple[tuple[Level, ...], View]:
    """Return the levels that are joined with a GridSample's, and their samples."""
    level, sampled = _level(node)
    end = list(results(sampled))[-1]
    concat = sole_reader(end.value)
    if concat is None or concat.op_type != "Concat" or not is_standard(concat):
        return (level,), end
    # Every operand of the Concat must be a GridSample of equal layout
    levels: list[Level] = []
    for value in concat.inputs:
        sampler = _sampler(value)
        if sampler is None:
            raise PreconditionError("what it samples is joined with something else")
        level, sampled = _level(sampler)
        last = list(results(sampled))[-1]
        if last.value is not value or last.layout != end.layout:
            raise PreconditionError(
                "the levels have different numbers of points or heads"
            )
        levels.append(level)
    # The axis of the Concat gets the level as its outer digit
    layout = list(end.layout)
    axis = concat.attributes.get_int("axis", 0) % len(layout)
    layout[axis] = (*whole(LEVEL, len(levels)), *layout[axis])
    together = View(concat.outputs[0], tuple(layout))
    return tuple(levels), list(results(together))[-1]


def _sampler(value: ir.Value | None) -> ir.Node | None:
    while (node := maker(value, *LAYOUT_OPERATORS)) is not None:
        value = node.inputs[0]
    return maker(value, "GridSample")


def _weighted(samples: View) -> tuple[View, View]:
    """Return the product of samples with weights that reads them, and the weights."""
    node = sole_reader(samples.value)
    if node is None or node.op_type != "Mul" or not is_standard(node):
        raise PreconditionError("what it samples is not multiplied by weights")
    other = node.inputs[node.inputs[0] is samples.value]
    shape, full = static_shape(other), static_shape(samples.value)
    if other is None or shape is None or static_shape(node.outputs[0]) != full:
        raise PreconditionError("what it samples is not multiplied by weights")
    layout = aligned(samples.layout, shape)
    if any(digit.axis == CHANNEL for digit in flat(layout)):
        raise PreconditionError("the weights differ from channel to channel")
    return dataclasses.replace(samples, value=node.outputs[0]), View(other, layout)


def _total(product: View, kinds: tuple[str, ...]) -> tuple[View, bool]:
    """Return the sum that reads a product, and whether it is a mean."""
    node = sole_reader(product.value)
    if node is None or node.op_type not in kinds or not is_standard(node):
        raise PreconditionError("the weighted samples are not summed")
    # Digits of the axes that are summed over are gone
    axes = integers_at(node, "axes", 1)
    if not axes:
        raise PreconditionError("the sum is over all axes, or over computed ones")
    over = {axis % len(product.layout) for axis in axes}
    keep = bool(node.attributes.get_int("keepdims", 1))
    layout = tuple(
        () if axis in over else digits
        for axis, digits in enumerate(product.layout)
        if keep or axis not in over
    )
    return View(node.outputs[0], layout), node.op_type == "ReduceMean"
