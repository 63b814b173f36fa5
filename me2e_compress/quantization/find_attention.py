"""Find attention: the matrix products around every softmax."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.graph import WEIGHTED, input_at, is_standard, static_shape
from me2e_compress.graph.nodes import maker
from me2e_compress.graph.shapes import open_shape
from me2e_compress.operators import op_types

# How many products are remembered a value: more than the heads of an attention that
# is written out head by head; a bound, so that sweeps stay linear.
KEEP = 16

Products: TypeAlias = tuple[ir.Node, ...]
Test: TypeAlias = Callable[[ir.Node], bool]


def behind(
    graph: ir.Graph, through: Collection[str], is_product: Test
) -> Mapping[ir.Value, Products]:
    """List, for every value, the products it comes from through some operators only.

    The graph is in topological order.
    """
    known: dict[ir.Value, Products] = {}
    for node in graph:
        if is_product(node):
            products: Products = (node,)
        elif node.op_type in through:
            products = _merged(known.get(v, ()) for v in node.inputs if v is not None)
        else:
            continue
        if products:
            known.update(dict.fromkeys(node.outputs, products))
    return known


def ahead(
    graph: ir.Graph, through: Collection[str], is_product: Test
) -> Mapping[ir.Value, Products]:
    """List, for every value, the products that read it through some operators only."""
    known: dict[ir.Value, Products] = {}
    beyond: dict[ir.Node, Products] = {}
    for node in reversed(graph):
        for value in node.outputs:
            known[value] = _merged(
                beyond.get(reader, ()) for reader in value.consumers()
            )
        # what reads a node's inputs: the product itself, or what lies ahead of it
        if is_product(node):
            beyond[node] = (node,)
        elif node.op_type in through:
            beyond[node] = _merged(known[value] for value in node.outputs)
    return known


def _merged(sources: Iterable[Products]) -> Products:
    """Return the products of several values, each once."""
    return tuple(dict.fromkeys(itertools.chain(*sources)))[:KEEP]


# Operators of ONNX and com.microsoft that are attention as a whole.
_FUSED = frozenset(
    {
        "Attention", "GroupQueryAttention", "MultiHeadAttention", "PackedAttention",
        "PackedMultiHeadAttention", "QAttention",
    }
)  # fmt: skip

_PRODUCTS = ("Einsum", "Gemm", "MatMul")

# What may stand between the softmax and the product with the values: dropout, masks,
# layout.
_LAYOUT = frozenset(
    {
        "Cast", "Div", "Dropout", "Expand", "Flatten", "Identity", "Mul", "Reshape",
        "Squeeze", "Transpose", "Unsqueeze", "Where",
    }
)  # fmt: skip

# What may stand between the product of queries and keys and the softmax: scale,
# masks (additive or boolean), relative positions, layout.
_SCORES = _LAYOUT | {"Add", "Clip", "Max", "Min", "Neg", "Sub"}


@dataclasses.dataclass(frozen=True)
class Attention:
    """The numbers of query and key tokens of an attention; None if open."""

    queries: int | None
    keys: int | None


def find_attention(
    model: ir.Model, constants: Collection[ir.Value]
) -> dict[ir.Node, Attention]:
    """Map every node that takes part in an attention to that attention.

    One sweep over the graph remembers, for every value, which products lie behind it,
    another which lie ahead; scaling, masks, casts and changes of layout are looked
    through. A softmax with a product behind it is an attention: that product is queries
    by keys, the one ahead weights by values. Products may be MatMul, Gemm or Einsum,
    the softmax may be written as five nodes. A mask's own products are told from the
    scores by their size. The search is linear in the graph.

    Operators that are attention as a whole (:func:`is_fused`) are mapped too. Sampling
    weights of deformable attention come from a linear layer, not from such a product,
    and are not attention here.

    Shapes must be inferred, and nodes in topological order. What multiplies one of
    ``constants`` from the left is a layer, not an attention, unless it is a batch of
    matrices (keys that are learned or known beforehand).
    """

    def is_product(node: ir.Node) -> bool:
        # The left operand may be constant: learned queries that saw no scene yet.
        if node.op_type not in _PRODUCTS or not is_standard(node):
            return False
        right = input_at(node, 1)
        if right is None:
            return False
        shape = static_shape(right) or ()
        return right not in constants or math.prod(shape[:-2]) > 1

    # products behind the scores, and ahead of the weights, of every softmax
    scored = behind(model.graph, _SCORES, is_product)
    weighed = ahead(model.graph, _LAYOUT, is_product)
    attentions: dict[ir.Node, Attention] = {}
    for node in model.graph:
        if is_fused(node):  # tokens of [batch, (heads,) tokens, width]
            shapes = [open_shape(value) or () for value in node.inputs[:2]]
            tokens = [shape[-2] if len(shape) > 1 else None for shape in shapes]
            attentions[node] = Attention(tokens[0], tokens[-1])
    for node in model.graph:
        weights, scores = node.outputs[0], _scores(node)
        if scores is None:
            continue
        # a mask may have products of its own, of another size
        products = scored.get(scores, ())
        queries_by_keys = [n for n in products if _may_be_scores(n.outputs[0], scores)]
        if not queries_by_keys:
            continue
        shape = open_shape(queries_by_keys[0].outputs[0]) or ()
        attention = Attention(*(shape[-2:] if len(shape) > 1 else (None, None)))
        for product in (*queries_by_keys, *weighed.get(weights, ())):
            attentions.setdefault(product, attention)
    return attentions


def find_attention_weights(
    model: ir.Model, attention: Collection[ir.Node]
) -> dict[ir.Node, str]:
    """Map every product that gives attention weights, or reads them, to the reason.

    Besides both products of an attention these are layers that read a softmax, as a
    mean position over bins does.
    """
    reasons = dict.fromkeys(attention, "gives or reads attention weights")
    softmaxes = behind(model.graph, _LAYOUT, lambda node: node.op_type == "Softmax")
    for node in model.graph:
        reads = node.inputs[:2] if node.op_type in WEIGHTED else ()
        if any(value in softmaxes for value in reads if value is not None):
            reasons.setdefault(node, "reads the weights that a softmax gives")
    return reasons


def _scores(node: ir.Node) -> ir.Value | None:
    """Return what a softmax is taken of; None of other nodes."""
    if node.op_type == "Softmax":
        return node.inputs[0]
    # In five nodes it ends with Div(Exp(x), ReduceSum(Exp(x)))
    above, below = node.inputs[:2] if node.op_type == "Div" else (None, None)
    power, total = maker(above, "Exp"), maker(below, "ReduceSum")
    if power is None or total is None or total.inputs[0] is not above:
        return None
    return power.inputs[0]


def _may_be_scores(product: ir.Value, scores: ir.Value) -> bool:
    """Return whether scores may be made of a product: as many, or rows repeated."""
    made, read = static_shape(product), static_shape(scores)
    if not made or not read:  # open shapes: compare rows if they are known
        rows = [(open_shape(value) or (None,))[-1] for value in (product, scores)]
        return None in rows or rows[0] == rows[1]
    size, wanted = math.prod(made), math.prod(read)
    return size == wanted or (made[-1] == read[-1] and size > 0 and wanted % size == 0)


def is_fused(node: ir.Node) -> bool:
    """Return whether a node is attention as a whole, a library's plugin or not."""
    return node.op_type in _FUSED or node.op_type in op_types("multi-head-attention")
