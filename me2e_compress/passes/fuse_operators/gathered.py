"""Find bilinear sampling that is written with Gather, and write it as GridSample.

mmcv's ``bilinear_grid_sample`` and the like avoid GridSample, which older TensorRT
lacks: they take the floor of each position, gather the four corners, and add them up,
times their shares. Only the floors and the sum are matched; that masks and shares are
those of GridSample is proven numerically.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import array_of, is_standard, static_shape
from me2e_compress.graph.nodes import (
    ELEMENTWISE,
    LAYOUT_OPERATORS,
    Array,
    maker,
    producer_of,
    sole_reader,
)
from me2e_compress.operators import FusedCall
from me2e_compress.operators.grid_sampler import GRID_SAMPLE_OPSET
from me2e_compress.passes.digits import Digit, flat, regrouped, sizes, whole
from me2e_compress.passes.fuse_operators.fused_form import laid_out
from me2e_compress.passes.fuse_operators.views import Selection, View, joined, sources

# The axes: all positions of all images, x before y, and those of a feature map.
AT, PAIR, CHANNEL, ROW, COLUMN = "at", "pair", "channel", "row", "column"

_INDEX = LAYOUT_OPERATORS | {*ELEMENTWISE, "Cast", "Clip", "Concat", "Expand", "Where"}
_INDEX |= {"Gather", "Slice", "Split", "Tile"}
_SUMS = ("Add", "ReduceSum", "Sum")
_AFTER = LAYOUT_OPERATORS | {*_SUMS, "Concat", "Mul", "Where"}

# How many pixels beyond a feature map's edges positions are drawn.
BEYOND = 3.0

# Fewer are not of all kinds: more than one draw is compared.
LEAST_POSITIONS = 60


@dataclasses.dataclass(frozen=True)
class Sampling:
    """A guess at what a sum of gathered corners samples, to be proven."""

    result: View  # the sum
    image: View  # the feature map
    shape: tuple[int, int, int, int]  # its [batch, channels, rows, columns]
    at: tuple[View, ...]  # positions: one value of both axes, or x and y
    scale: tuple[float, float]  # takes these to pixels, for x and for y
    shift: tuple[float, float]  # is then added; 0 is the middle of the first pixel

    @property
    def draws(self) -> int:
        """How many draws hold enough positions."""
        return math.ceil(LEAST_POSITIONS / math.prod(sizes(self.at[0].layout)))

    def draw(self, random: np.random.Generator) -> dict[ir.Value, Array]:
        """Draw normal numbers for the image, and positions inside and around it."""
        # Positions are pixels, taken back through scale and shift
        image = random.standard_normal(sizes(self.image.layout))
        drawn: dict[ir.Value, Array] = {self.image.value: image.astype(np.float32)}
        for place, view in enumerate(self.at):
            digits = flat(view.layout)
            axes = [2 if digit.axis == PAIR else 1 for digit in digits]
            part = slice(None) if 2 in axes else slice(place, place + 1)
            size, scale, shift = (
                np.reshape(pair[part], axes)
                for pair in (self.shape[:1:-1], self.scale, self.shift)
            )
            # Half of them anywhere, half at the edges, a tenth in the middle of pixels
            shape = [digit.size for digit in digits]
            pixels = random.uniform(-BEYOND, size + BEYOND - 1, shape)
            low = random.uniform(-BEYOND, 1, shape)
            edge = np.where(random.random(shape) < 0.5, low, size - 1 - low)
            pixels = np.where(random.random(shape) < 0.5, pixels, edge)
            pixels = np.where(random.random(shape) < 0.1, pixels.round(), pixels)
            places = ((pixels - shift) / scale).reshape(sizes(view.layout))
            drawn[view.value] = places.astype(np.float32)
        return drawn

    def write(self, call: FusedCall) -> ir.Value:
        """Write the GridSample, and what brings its operands and result in shape."""
        # Positions as a grid [N, F, G, 2]: G is as long as the last axis allows
        batch, channels, rows, columns = self.shape
        layout = self.result.layout
        places = tuple(digits for digits in layout if digits and digits[-1].axis == AT)
        total = math.prod(sizes(places))
        width = math.gcd(total // batch, sizes((places or ((),))[-1:])[0])
        form = regrouped((whole(AT, total),), (batch, total // batch // width, width))
        assert form is not None
        first, second = form[0], whole(CHANNEL, channels)
        maps = (first, second, whole(ROW, rows), whole(COLUMN, columns))
        # Image [N, C, H, W], and x and y beside each other
        image = laid_out(call, self.image, maps)
        pair = whole(PAIR, 2) if len(self.at) == 1 else ()
        grid = call.concat([laid_out(call, v, (*form, pair)) for v in self.at], 3)
        # To -1..1, with corners aligned where positions are so already
        size = np.array(self.shape[:1:-1], np.float64)
        scale, shift = 2 * np.array(self.scale), 2 * np.array(self.shift)
        corners = int(np.allclose((scale, shift), size - 1) and size.min() > 1)
        size -= corners
        scale, shift = scale / size, (shift + 1 - corners) / size - 1
        for op_type, exact, nothing in (("Mul", scale, 1.0), ("Add", shift, 0.0)):
            numbers = exact.round(6) if np.allclose(exact, exact.round(6)) else exact
            if (numbers != nothing).any():
                number = numbers if np.ptp(numbers) else numbers[:1]
                grid = call.add(op_type, [grid, call.numbers(number, grid)])
        made = call.add("GridSample", [image, grid], {"align_corners": corners})
        return laid_out(call, View(made, (first, second, *form[1:])), layout)


def is_sampler(node: ir.Node) -> bool:
    """Return whether a node gathers at indices that are made of floors."""
    gathers = node.op_type in ("Gather", "GatherElements", "GatherND")
    return gathers and is_standard(node) and bool(floors_of(node))


def floors_of(node: ir.Node) -> tuple[ir.Value, ...]:
    """Return the values whose floors a Gather's indices are made of."""
    values = (n.inputs[0] for n in _behind(node.inputs[1]) if n.op_type == "Floor")
    return tuple(dict.fromkeys(value for value in values if value is not None))


def _behind(index: ir.Value | None) -> list[ir.Node]:
    """List the nodes that make an index, back to the floors of positions."""
    nodes: dict[ir.Node, None] = {}
    waiting = [index]
    while waiting:
        node = producer_of(waiting.pop())
        if node is None or node in nodes or not is_standard(node):
            continue
        if node.op_type == "Floor" or node.op_type in _INDEX:
            nodes[node] = None
            waiting.extend(() if node.op_type == "Floor" else node.inputs)
    return list(nodes)


def guesses(node: ir.Node, opset: int) -> Iterator[Sampling]:
    """Guess what the sum of corners samples that a Gather takes part in, best first."""
    if opset < GRID_SAMPLE_OPSET:
        raise PreconditionError(f"GridSample needs opset {GRID_SAMPLE_OPSET}")
    image, borders, widths = _image(node)
    for at, scale, shift in _positions(floors_of(node)):
        total = math.prod(sizes(at[0].layout)) // (3 - len(at))
        for result in _sums(node):
            maps = _maps(image, result, widths, total)
            for (shape, taken, summed), border in itertools.product(maps, borders):
                moved = shift[0] - border, shift[1] - border
                yield Sampling(summed, taken, shape, at, scale, moved)


def _image(node: ir.Node) -> tuple[ir.Value, tuple[int, ...], list[int]]:
    """Return the feature map of a Gather, borders it may have, and numbers of columns.

    The border is a Pad. Without one, the columns are a factor of the index, or a
    dimension.
    """
    data = value = node.inputs[0]
    while (before := maker(value, *LAYOUT_OPERATORS, "Pad")) is not None:
        value = before.inputs[0]
        small, large = static_shape(value), static_shape(before.outputs[0])
        if before.op_type != "Pad" or value is None or not (small and large):
            continue
        sides = [pair for pair in zip(small, large, strict=True) if pair[0] != pair[1]]
        if sides:
            inner, outer = sides[-1]
            return value, (0, (outer - inner) // 2), [inner]
    shape = static_shape(data)
    if data is None or shape is None or data.dtype != ir.DataType.FLOAT:
        raise PreconditionError("it gathers no float32 of a known shape")
    products = [made for made in _behind(node.inputs[1]) if made.op_type == "Mul"]
    arrays = [array_of(value) for made in products for value in made.inputs]
    factors = [int(a.item()) for a in arrays if a is not None and a.size == 1]
    return data, (0,), [n for n in dict.fromkeys((*factors, *shape[1:])) if n > 0]


def _maps(
    image: ir.Value, result: ir.Value, widths: list[int], total: int
) -> Iterator[tuple[tuple[int, int, int, int], View, View]]:
    """Describe image and result with their channels before or behind all else."""
    have, made = static_shape(image) or (0,), static_shape(result) or (0,)
    channels = math.prod(made) // total
    batches = dict.fromkeys((have[0], made[0], 1))
    for batch, columns in itertools.product(batches, widths):
        if not batch * channels:
            continue
        # Several images are the first axis of the map, of positions and of the sum
        rows = math.prod(have) // (batch * channels * columns)
        outer = (Digit(AT, total // batch, batch),) if batch > 1 else ()
        inner, channel = whole(AT, total // batch), whole(CHANNEL, channels)
        pixels = (*whole(ROW, rows), *whole(COLUMN, columns))
        maps = (outer, channel, pixels), (outer, pixels, channel)
        sums = (outer, channel, inner), (outer, inner, channel)
        for one, two in itertools.product(maps, sums):
            taken, summed = regrouped(one, have), regrouped(two, made)
            if taken is not None and summed is not None:
                shape = batch, channels, rows, columns
                yield shape, View(image, taken), View(result, summed)


_Positions = tuple[tuple[View, ...], tuple[float, float], tuple[float, float]]


def _positions(floors: tuple[ir.Value, ...]) -> Iterator[_Positions]:
    """Trace positions back to where their elements come from: to one value first."""
    walks = [list(sources(_position(v, is_pair=len(floors) == 1))) for v in floors]
    far = [[view for view in walk if isinstance(view, View)][-1] for walk in walks]
    if len(far) == 1 and any(digit.axis == PAIR for digit in flat(far[0].layout)):
        yield _unscaled(far, far * 2)
    if len(far) != 2:
        return
    parts = [walk[-1] for walk in walks if isinstance(walk[-1], Selection)]
    for pair in itertools.permutations(parts, 2):
        plain = [
            dataclasses.replace(part, view=View(part.view.value, part.view.layout))
            for part in pair
        ]
        together = joined(plain, whole(PAIR, 2))
        if together is not None:
            yield _unscaled([together], [part.view for part in pair])
    # Else each is a value of its own
    for both in itertools.permutations(far):
        yield _unscaled(both, both)


def _unscaled(at: Sequence[View], axes: Sequence[View]) -> _Positions:
    x, y = axes
    plain = tuple(View(view.value, view.layout) for view in at)
    return plain, (x.scale, y.scale), (x.shift, y.shift)


def _position(value: ir.Value, *, is_pair: bool) -> View:
    """Describe what a floor is taken of, or what that was before it was clipped."""
    while (clip := maker(value, "Clip")) is not None and clip.inputs[0] is not None:
        value = clip.inputs[0]
    shape = static_shape(value)
    if shape is None:
        raise PreconditionError("its shapes are not known: run fold-constants first")
    is_pair = is_pair and shape[-1:] == (2,)
    where = shape[:-1] if is_pair else shape
    layout = regrouped((whole(AT, math.prod(where)),), where)
    assert layout is not None
    return View(value, (*layout, whole(PAIR, 2)) if is_pair else layout)


def _sums(node: ir.Node) -> list[ir.Value]:
    """Return the sums that follow a Gather, the last first."""
    terms: list[ir.Value] = []
    value = node.outputs[0]
    while (reader := sole_reader(value)) is not None and is_standard(reader):
        if reader.op_type not in _AFTER:
            break
        value = reader.outputs[0]
        if reader.op_type in _SUMS and static_shape(value) is not None:
            terms.append(value)
    return terms[::-1]
