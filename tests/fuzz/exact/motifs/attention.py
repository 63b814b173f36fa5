"""Attention as exporters write it, deformable too: decomposed or as a plugin."""

import dataclasses
import math

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import BOOL, Builder, Dim, Val, product, sizes
from tests.fuzz.exact.motifs.layers import layer


@dataclasses.dataclass(frozen=True)
class _Sizes:
    batch: Dim
    queries: int
    keys: int
    heads: int
    depth: int
    merged: bool

    @property
    def wide(self) -> int:
        return self.heads * self.depth


def _drawn(b: Builder) -> _Sizes:
    batch = b.shared.batch
    if isinstance(batch, int):
        batch = b.rng.choice((1, batch, batch, 12, 64))
    queries, keys = b.rng.choice((1, 2, 5)), b.rng.choice((3, 6, 20))
    if b.chance(0.3):
        queries = keys
    heads, depth = b.rng.choice((1, 2, 4)), b.rng.choice((2, 4, 8))
    return _Sizes(batch, queries, keys, heads, depth, b.chance(0.35))


def _heads(b: Builder, x: Val, s: _Sizes, *, last: bool) -> Val:
    """Cut a value [B, J, HD] into [B, H, J, D], or [B, H, D, J] where ``last``."""
    split = sp.reshape(b, x, (*x.shape[:2], s.heads, s.depth))
    order = (0, 2, 3, 1) if last else (0, 2, 1, 3)
    if last and b.chance(0.4):
        turned = sp.transpose(b, split, (0, 2, 1, 3))
        return sp.transpose(b, turned, (0, 1, 3, 2))
    return sp.transpose(b, split, order)


def _merged_heads(b: Builder, x: Val, s: _Sizes, *, last: bool) -> Val:
    """Cut a value [J, B, HD] into [BH, J, D], or [BH, D, J] where ``last``."""
    joined = product([x.shape[1], s.heads])
    split = sp.reshape(b, x, (x.shape[0], joined, s.depth))
    if last and b.chance(0.6):
        return sp.transpose(b, split, (1, 2, 0))
    turned = sp.transpose(b, split, (1, 0, 2))
    return sp.transpose(b, turned, (0, 2, 1)) if last else turned


def _scale(b: Builder, x: Val, s: _Sizes) -> Val:
    kind = b.rng.choice(("Mul", "Div"))
    root = math.sqrt(s.depth) if kind == "Div" else 1 / math.sqrt(s.depth)
    return sp.either_way(b, kind, x, sp.scalar(b, root))


def _source(b: Builder, s: _Sizes, count: int, width: int) -> Val:
    """Make tokens [B, J, width] or [J, B, width], which the batch may share."""
    at = int(s.merged)  # the axis of the batch
    whole: tuple[Dim, ...] = (count, s.batch) if s.merged else (s.batch, count)
    whole += (width,)
    if isinstance(s.batch, int) and b.chance(0.4):
        one, repeats = list(sizes(whole)), [1, 1, 1]
        one[at], repeats[at] = 1, s.batch
        small = b.input(one)
        if b.chance(0.4):
            return sp.tile(b, small, repeats)
        if b.chance(0.7):
            return sp.expand(b, small, sizes(whole))
        return sp.binary(b, "Add", small, b.input(whole))
    return b.pick(lambda each: each.shape == whole) or b.input(whole)


def _projected(b: Builder, x: Val, s: _Sizes) -> Val:
    made = layer(b, x, s.wide)
    if b.chance(0.2):
        narrow = b.input([*x.shape[:2], 2])
        made = sp.binary(b, "Add", made, sp.matmul(b, narrow, b.weight((2, s.wide))))
    return made


def _masked(b: Builder, scores: Val, s: _Sizes) -> Val:
    kind = b.rng.random()
    shape = (s.queries, s.keys)
    if kind < 0.4:
        return scores
    if kind < 0.7:
        mask = np.where(b.draws.random(shape) < 0.3, -1e4, 0.0)
        return sp.binary(b, "Add", scores, b.const(np.asarray(mask, b.dtype)))
    keep = b.draws.random(shape) < 0.7
    keep[:, 0] = True
    if b.chance(0.5):
        chosen = b.const(keep)
    else:
        chosen = b.op("Not", [b.const(~keep)], shape, dtype=BOOL)
    least = sp.scalar(b, b.rng.choice((-1e4, -math.inf)), 0)
    kept = [chosen, scores, least]
    return b.hide(b.op("Where", kept, scores.shape, dtype=b.dtype))


def attention(b: Builder) -> None:
    """Queries, keys, scores, softmax, values, and a layer behind."""
    s = _drawn(b)
    width = b.rng.choice((4, 8, s.wide))
    x = _source(b, s, s.queries, width)
    same = s.queries == s.keys and b.chance(0.6)
    y = x if same else _source(b, s, s.keys, width)
    cut = _merged_heads if s.merged else _heads
    q_rows = _projected(b, x, s)
    k_rows = _projected(b, y, s)
    v_rows = _projected(b, y if b.chance(0.7) else _source(b, s, s.keys, width), s)
    place = b.rng.choice(("q", "k", "scores", "none", "rows"))
    if place == "rows":
        q_rows = _scale(b, q_rows, s)
    q = cut(b, q_rows, s, last=False)
    k = cut(b, k_rows, s, last=True)
    v = cut(b, v_rows, s, last=False)
    if place == "q":
        q = _scale(b, q, s)
    if place == "k":
        k = _scale(b, k, s)
    scores = sp.matmul(b, q, k)
    if place == "scores":
        scores = _scale(b, scores, s)
    chances = sp.softmax(b, _masked(b, scores, s), scores.rank - 1)
    mixed = sp.matmul(b, chances, v)
    _joined(b, mixed, s)


def _joined(b: Builder, mixed: Val, s: _Sizes) -> None:
    turned = sp.transpose(b, mixed, (1, 0, 2) if s.merged else (0, 2, 1, 3))
    lead = (s.queries, s.batch) if s.merged else (s.batch, s.queries)
    rows = sp.reshape(b, turned, (*lead, s.wide))
    if b.chance(0.6):
        layer(b, rows)


def shared_operand(b: Builder) -> None:
    """A product whose other side is partly the same for the whole batch."""
    s = dataclasses.replace(_drawn(b), batch=b.rng.choice((4, 24, 64)))
    batch = s.batch
    assert isinstance(batch, int)
    table = (s.keys, 1, s.wide) if s.merged else (1, s.keys, s.wide)
    whole = (s.keys, batch) if s.merged else (batch, s.keys)
    shared = b.input(table) if b.chance(0.7) else b.const(b.normal(table))
    own = sp.matmul(b, b.input([*whole, 2]), b.weight((2, s.wide)))
    if b.chance(0.5):
        own = sp.binary(b, "Add", own, b.weight((s.wide,), 1))
    if b.chance(0.2):
        own = sp.expand(b, shared, (*whole, s.wide))
    both = own
    if own.name != shared.name and b.chance(0.85):
        kind = b.rng.choice(("Add", "Add", "Sub"))
        both = sp.either_way(b, kind, shared, own)
    cut = _merged_heads if s.merged else _heads
    last = b.chance(0.5)
    right = cut(b, both, s, last=last)
    if b.chance(0.4):
        right = _scale(b, right, s)
    inner = s.depth if last else s.keys
    sp.matmul(b, b.input([*right.shape[:-2], s.queries, inner]), right)


DOMAINS = (
    ("trt.plugins", "MultiscaleDeformableAttnPlugin_TRT", False),
    ("me2e", "MultiScaleDeformableAttention", False),
    ("mmdeploy", "MMCVMultiScaleDeformableAttention", True),
    ("custom_op", "MultiScaleDeformableAttentionPlugin", True),
)
"""Domain and name of the plugin in some dialects; whether heads are joined."""


@dataclasses.dataclass(frozen=True)
class _Levels:
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


def _drawn_levels(b: Builder) -> _Levels:
    levels = tuple(
        (b.rng.randint(1, 4), b.rng.randint(2, 4)) for _ in range(b.rng.randint(1, 2))
    )
    draw = b.rng.randint
    return _Levels(draw(1, 2), draw(1, 3), draw(1, 2), draw(1, 3), draw(1, 3), levels)


def _operands(b: Builder, s: _Levels) -> tuple[Val, Val, Val]:
    count = len(s.levels)
    value = b.input((s.n, s.pixels, s.m, s.d))
    raw = b.input((s.n, s.q, s.m, count, s.p, 2))
    where = b.op("Sigmoid", [raw], raw.shape)
    scores = b.input((s.n, s.q, s.m, count * s.p))
    soft = sp.softmax(b, scores, 3)
    weights = sp.reshape(b, soft, (s.n, s.q, s.m, count, s.p))
    return value, where, weights


def _sampled(b: Builder, s: _Levels, value: Val, grids: Val) -> Val:
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
    s = _drawn_levels(b)
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
    s = _drawn_levels(b)
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
