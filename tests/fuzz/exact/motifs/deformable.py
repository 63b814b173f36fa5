"""Deformable attention, decomposed or as a plugin, and masks and sums over images."""

import dataclasses
import math

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.values import Val

DOMAINS = (
    ("trt.plugins", "MultiscaleDeformableAttnPlugin_TRT", False),
    ("me2e", "MultiScaleDeformableAttention", False),
    ("mmdeploy", "MMCVMultiScaleDeformableAttention", True),
    ("custom_op", "MultiScaleDeformableAttentionPlugin", True),
)
"""Domain and name of the plugin in some dialects; whether heads are joined."""


@dataclasses.dataclass(frozen=True)
class _Sizes:
    """Images, queries, heads, points, channels, and the size of every level."""

    n: int
    q: int
    m: int
    p: int
    d: int
    levels: tuple[tuple[int, int], ...]

    @property
    def pixels(self) -> int:
        return sum(math.prod(level) for level in self.levels)


def _drawn(b: Builder) -> _Sizes:
    levels = tuple(
        (b.rng.randint(1, 4), b.rng.randint(2, 4)) for _ in range(b.rng.randint(1, 2))
    )
    draw = b.rng.randint
    return _Sizes(draw(1, 2), draw(1, 3), draw(1, 2), draw(1, 3), draw(1, 3), levels)


def _operands(b: Builder, s: _Sizes) -> tuple[Val, Val, Val]:
    count = len(s.levels)
    value = b.input((s.n, s.pixels, s.m, s.d))
    raw = b.input((s.n, s.q, s.m, count, s.p, 2))
    where = b.op("Sigmoid", [raw], raw.shape)
    scores = b.input((s.n, s.q, s.m, count * s.p))
    soft = sp.softmax(b, scores, 3)
    weights = sp.reshape(b, soft, (s.n, s.q, s.m, count, s.p))
    return value, where, weights


def _sampled(b: Builder, s: _Sizes, value: Val, grids: Val) -> Val:
    """Sample every level and put the samples side by side: [NM, D, Q, LP]."""
    start, parts = 0, []
    for at, (height, width) in enumerate(s.levels):
        piece = sp.slice_(b, value, 1, start, start + height * width)
        start += height * width
        flat = sp.reshape(b, piece, (s.n, height * width, s.m * s.d))
        turned = sp.transpose(b, flat, (0, 2, 1))
        image = sp.reshape(b, turned, (s.n * s.m, s.d, height, width))
        index = b.const(np.asarray(at, np.int64))
        grid = sp.transpose(b, sp.gather(b, grids, index, 3), (0, 2, 1, 3, 4))
        grid = sp.reshape(b, grid, (s.n * s.m, s.q, s.p, 2))
        parts.append(sp.unsqueeze(b, _grid_sample(b, image, grid), 3))
    stacked = sp.concat(b, parts, 3)
    return sp.reshape(b, stacked, (s.n * s.m, s.d, s.q, len(s.levels) * s.p))


def _grid_sample(b: Builder, image: Val, grid: Val, corners: float = 0.0) -> Val:
    """Sample an image; corners are aligned with some probability."""
    attributes = {
        "mode": "bilinear" if b.opset < 20 else "linear",
        "padding_mode": b.rng.choice(("zeros",) * 5 + ("border",)),
        "align_corners": int(corners > 0 and b.chance(corners)),
    }
    shape = (*image.shape[:2], *grid.shape[1:3])
    return b.op("GridSample", [image, grid], shape, attributes)


def decomposed(b: Builder) -> None:
    """Write it as torch exports mmcv's, with a mask and a sum over images at times."""
    if b.opset < 16 or b.is_double:
        return
    s = _drawn(b)
    value, where, weights = _operands(b, s)
    twice = sp.binary(b, "Mul", where, sp.scalar(b, 2.0, 0))
    grids = sp.binary(b, "Sub", twice, sp.scalar(b, 1.0, 0))
    samples = _sampled(b, s, value, grids)
    turned = sp.transpose(b, weights, (0, 2, 1, 3, 4))
    ones = sp.reshape(b, turned, (s.n * s.m, 1, s.q, len(s.levels) * s.p))
    weighted = sp.binary(b, "Mul", samples, ones)
    total = sp.reduce(b, "ReduceSum", weighted, [3], keep=False)
    heads = sp.reshape(b, total, (s.n, s.m * s.d, s.q))
    y = sp.transpose(b, heads, (0, 2, 1))
    if b.chance(0.4):
        y = sp.binary(b, "Mul", y, b.input((s.n, s.q, 1)))
    if b.chance(0.5):
        sp.reduce(b, b.rng.choice(("ReduceSum", "ReduceMean")), y, [0], keep=False)


def rotated_view(b: Builder) -> None:
    """Sample the last frame's view, [H W, 1, C], where its pixels are now."""
    if b.opset < 16 or b.is_double:
        return
    channels = b.rng.choice((3, 16, 16))
    height, width = b.rng.choice(((4, 5), (3, 1)))
    rows = b.input((height * width, 1, channels))
    turned = sp.transpose(b, rows, (1, 2, 0))
    image = sp.reshape(b, turned, (1, channels, height, width))
    grid = b.input((1, height, width, 2))
    sample = _grid_sample(b, image, grid, corners=0.1)
    flat = sp.reshape(b, sample, (1, channels, height * width))
    sp.transpose(b, flat, (0, 2, 1))
    sp.at_times(b, 0.3, sample)


def plugin(b: Builder) -> None:
    """Write it as one node of a plugin library."""
    if b.opset < 13 or b.is_double:
        return
    s = _drawn(b)
    value, where, weights = _operands(b, s)
    domain, kind, joined = b.rng.choice(DOMAINS)
    areas = [math.prod(level) for level in s.levels]
    starts = np.cumsum([0, *areas[:-1]])
    sizes, first = (
        b.const(np.array(each, np.int32), plain=True) for each in (s.levels, starts)
    )
    inputs = [value, sizes, first, where, weights]
    shape = (s.n, s.q, s.m * s.d) if joined else (s.n, s.q, s.m, s.d)
    y = b.op(kind, inputs, shape, domain=domain)
    sp.unary(b, y)
