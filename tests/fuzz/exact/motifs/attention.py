"""Attention as exporters write it: heads cut out, scaled, masked, mixed."""

import dataclasses
import math

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.motifs.linear import layer
from tests.fuzz.exact.values import BOOL, Dim, Val, product


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
    factor = sp.scalar(b, root)
    return sp.either_way(b, kind, x, factor)


def _source(b: Builder, s: _Sizes, count: int, width: int) -> Val:
    """Make tokens [B, J, width] or [J, B, width], which the batch may share."""
    pair: tuple[Dim, Dim] = (count, s.batch) if s.merged else (s.batch, count)
    if isinstance(s.batch, int) and b.chance(0.4):
        one = (count, 1, width) if s.merged else (1, count, width)
        small = b.input(one)
        whole = (count, s.batch, width) if s.merged else (s.batch, count, width)
        if b.chance(0.4):
            repeats = (1, s.batch, 1) if s.merged else (s.batch, 1, 1)
            return sp.tile(b, small, repeats)
        if b.chance(0.7):
            return sp.expand(b, small, whole)
        return sp.binary(b, "Add", small, b.input([*pair, width]))
    found = b.pick(lambda each: each.shape == (*pair, width))
    return found or b.input([*pair, width])


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
    if s.merged:
        turned = sp.transpose(b, mixed, (1, 0, 2))
        rows = sp.reshape(b, turned, (s.queries, s.batch, s.wide))
    else:
        turned = sp.transpose(b, mixed, (0, 2, 1, 3))
        rows = sp.reshape(b, turned, (s.batch, s.queries, s.wide))
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
    lead = right.shape[:-2]
    left = b.input([*lead, s.queries, inner])
    sp.matmul(b, left, right)
