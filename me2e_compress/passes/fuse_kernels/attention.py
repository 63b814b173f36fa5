"""Fuse attention over long sequences: product, softmax, product."""

import math
from typing import NamedTuple

import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph.nodes import (
    maker,
    permutation_of,
    scalar_of,
    sole_maker,
    sole_reader,
)
from me2e_compress.graph.rewrite import bypass
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET
from me2e_compress.graph.shapes import static_shape
from me2e_compress.operators import OWN_DOMAIN, FusedCall
from me2e_compress.operators.kernels.kernel import ATTENTION

# How near to 1 / sqrt(C) a scale must be, relative, to need no product.
_SAME = 1e-6

# By rank, the order of a Transpose that takes heads from rows into the batch; the same
# takes them back.
_ROWS = {3: [1, 0, 2], 4: [0, 2, 1, 3]}

# The order of one that turns the keys as well.
_KEYS = {3: [1, 2, 0], 4: [0, 2, 3, 1]}

# Queries and keys below which there is next to nothing to gain
LEAST_QUERIES, LEAST_KEYS = 8, 64

WIDEST = 128
"""Channels of a head up to which it is measured."""

# What the kernel may take of the time of the nodes, by the model of `pays`
_WORTH = 0.95

_FLOAT = ir.DataType.FLOAT
_Shape = tuple[int, ...]


class _Attention(NamedTuple):
    """Softmax(scale * query turned_key) value, with the heads in the batch.

    query [.., Q, C], turned_key [.., C, K], value [.., K, C].
    """

    query: ir.Value
    turned_key: ir.Value
    value: ir.Value
    scale: float


def fuse_attention(node: ir.Node, call: FusedCall) -> ir.Value | None:
    """Fuse attention that ends at a MatMul, where a compiled kernel is faster.

    Given:   y = MatMul(Softmax(MatMul(Mul(q, scale), k^T)), v)

    Result:  y = me2e::MultiHeadAttention(q, k, v)

    Transposes that put the heads of q, k and v into the batch, and those behind y that
    undo it, are removed too.
    """
    softmax = maker(node.inputs[0], "Softmax")
    attention = None if softmax is None else _match(node, softmax)
    if attention is None or softmax is None:
        return None
    if call.opset < OLDEST_OPSET:
        raise PreconditionError(f"fused nodes need opset {OLDEST_OPSET} or later")
    shape = _checked(attention, softmax)
    reads = _rows_behind(attention, len(shape))
    *_, keys = static_shape(attention.turned_key) or (0,)
    queries, channels, heads = *shape[-2:], math.prod(shape[:-2])
    if not pays(queries, keys, heads, channels, rows=bool(reads)):
        sizes = f"{queries} queries, {keys} keys, {heads} heads of {channels}"
        raise PreconditionError(f"its nodes are as fast: {sizes}")
    return _fused(call, attention, shape, reads)


def pays(queries: int, keys: int, heads: int, channels: int, *, rows: bool) -> bool:
    """Return whether the kernel is faster than the nodes.

    ``rows``: Transposes take the heads from rows into the batch and back, which the
    kernel does not need. The numbers are nanoseconds on one core of an AMD EPYC (Zen
    4), fitted to 131 shapes, each measured twice (``benchmarks.measure.fusions``): 1 to
    1,024 queries, 4 to 768 keys, 4 heads of 16 and of 128 channels, 8 of 32.
    """
    scores, padded = queries * keys, 16 * math.ceil(queries / 16)  # whole vectors
    far = 0.2 * (scores > 1 << 17)  # in onnxruntime they are stored: 512 kB of a head
    nodes = scores * (0.04 * channels + 0.2 + far) + 36 * queries
    if rows:
        nodes += queries * (0.74 * channels + 5.6) + keys * (0.82 * channels + 5)
    else:  # only the keys are turned
        nodes += 0.25 * keys * channels
    kernel = padded * (keys * (0.035 * channels + 0.29) + 0.0014 * channels**2)
    kernel += (1.26 * queries + 0.22 * keys) * channels
    return 5_800 + heads * kernel < _WORTH * (6_300 + 2_800 * rows + heads * nodes)


def _rows_behind(attention: _Attention, rank: int) -> list[ir.Value | None]:
    """Return what Transposes take the heads of all three from, or nothing."""
    turns = [maker(value, "Transpose") for value in attention[:3]]
    orders = [_ROWS.get(rank), _KEYS.get(rank), _ROWS.get(rank)]
    reads = [
        turn.inputs[0]
        for turn, order in zip(turns, orders, strict=True)
        if turn is not None and order and permutation_of(turn) == order
    ]
    return reads if len(reads) == len(turns) else []


def _match(node: ir.Node, softmax: ir.Node) -> _Attention | None:
    """Return the parts of an attention; None if there are not two products."""
    scores, scale = _unscaled(softmax.inputs[0])
    product, value = maker(scores, "MatMul"), node.inputs[1]
    if product is None:
        masked = maker(scores, "Add", "Where", "Sub")
        if masked and any(maker(_unscaled(e)[0], "MatMul") for e in masked.inputs):
            raise PreconditionError("its scores have a mask")
        return None
    query, by_query = _unscaled(product.inputs[0])
    turned, by_key = _unscaled(product.inputs[1])
    # Scores and weights must be read by nothing else
    for inner in (product.outputs[0], softmax.inputs[0], softmax.outputs[0]):
        if inner is None or sole_reader(inner) is None:
            raise PreconditionError("others read its scores or weights")
    if query is None or turned is None or value is None:
        return None
    return _Attention(query, turned, value, scale * by_query * by_key)


def _unscaled(value: ir.Value | None) -> tuple[ir.Value | None, float]:
    """Return a value before it was scaled by constants, and their product."""
    scale, node = 1.0, maker(value, "Mul", "Div")
    while node is not None:
        factor, number = node.inputs[0], scalar_of(node.inputs[1])
        if number is None and node.op_type == "Mul":
            number, factor = scalar_of(node.inputs[0]), node.inputs[1]
        if not number:
            break
        scale = scale * number if node.op_type == "Mul" else scale / number
        value, node = factor, sole_maker(factor, "Mul", "Div")
    return value, scale


def _checked(attention: _Attention, softmax: ir.Node) -> _Shape:
    """Return the shape [.., Q, C] of the query; refuse what the kernel cannot do."""
    # query [.., Q, C], key [.., C, K] and value [.., K, C] must be matrices
    shapes = [static_shape(value) for value in attention[:3]]
    query, key, value = shapes
    if query is None or key is None or value is None:
        raise PreconditionError("its shapes are not known")
    if min(map(len, (query, key, value))) < 2:
        raise PreconditionError("one of its operands is a vector")
    # All that the kernel requires, with what to say of a node that lacks it
    operands, (*batch, count, width), keys = attention[:3], query, key[-1]
    like = key == (*batch, width, keys) and value == (*batch, keys, width)
    axis = softmax.attributes.get_int("axis", -1)
    problems = {
        "its products are int8": any(maker(v, "DequantizeLinear") for v in operands),
        "it is not of float32 numbers": any(v.dtype != _FLOAT for v in operands),
        "query, key and value are of different batches or sizes": not like,
        "its softmax is not over the last axis": axis not in (-1, len(query) - 1),
        f"a head has more than {WIDEST} channels": width > WIDEST,
        f"its queries and keys are few: {count} and {keys}": (
            count < LEAST_QUERIES or keys < LEAST_KEYS
        ),
    }
    for problem, is_there in problems.items():
        if is_there:
            raise PreconditionError(problem)
    return query


def _fused(
    call: FusedCall,
    attention: _Attention,
    shape: _Shape,
    reads: list[ir.Value | None],
) -> ir.Value:
    """Write attention of the rows that Transposes read, or of heads in the batch."""
    # softmax(s q k) = softmax(f q k / sqrt(C)) with f = s sqrt(C)
    rank, width = len(shape), shape[-1]
    factor = attention.scale * math.sqrt(width)
    if reads:
        rows = [_viewed(call, read, -2) for read in reads]
        result = _attention(call, rows, factor, shape[-3])
        split = call.reshape(result, static_shape(reads[0]) or ())
        # What takes the heads out of the batch again is done already
        for reader in call.node.outputs[0].consumers():
            back = reader.outputs[0]
            if maker(back, "Transpose") and permutation_of(reader) == _ROWS[rank]:
                bypass(back, split)
        return call.transpose(split, _ROWS[rank])
    # Heads are in the batch already: only the keys are turned, [.., K, C]
    last = [*range(rank - 2), rank - 1, rank - 2]
    turn = maker(attention.turned_key, "Transpose")
    if turn is not None and permutation_of(turn) == last:
        key = turn.inputs[0]
    else:
        key = call.transpose(attention.turned_key, last)
    operands = (attention.query, key, attention.value)
    rows = [_viewed(call, value, -1) for value in operands]
    return call.reshape(_attention(call, rows, factor, 1), shape)


def _viewed(call: FusedCall, value: ir.Value | None, rows: int) -> ir.Value:
    """Return a value as [B, rows, C]: join the axes before, and those after, ``rows``.

    ``rows`` counts from the end. If the value is a Reshape of one of that shape, that
    one is returned.
    """
    shape = static_shape(value)
    assert value is not None
    assert shape is not None
    at = len(shape) + rows - 1
    wanted = (math.prod(shape[:at]), shape[at], math.prod(shape[at + 1 :]))
    before = maker(value, "Reshape")
    for known in (value, None if before is None else before.inputs[0]):
        if known is not None and static_shape(known) == wanted:
            return known
    return call.reshape(value, wanted)


def _attention(
    call: FusedCall, rows: list[ir.Value], factor: float, heads: int
) -> ir.Value:
    """Write the fused node; ``factor`` is the scale divided by 1 / sqrt(C)."""
    query, key, value = rows
    if abs(factor - 1) > _SAME:
        query = call.add("Mul", [query, call.numbers(factor, query)])
    attributes = {"heads": heads} if heads > 1 else {}
    result = call.add(ATTENTION, (query, key, value), attributes, domain=OWN_DOMAIN)
    result.type, result.shape = query.type, query.shape
    return result
