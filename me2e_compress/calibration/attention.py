"""Find attention: the matrix products around every softmax."""

import dataclasses
from collections import deque
from collections.abc import Collection, Iterable, Iterator

import onnx_ir as ir

from me2e_compress.graph import static_shape

FUSED = frozenset(
    {"Attention", "GroupQueryAttention", "MultiHeadAttention", "PackedAttention"}
)
"""Operators that are attention as a whole (ONNX 23, com.microsoft)."""

_PRODUCTS = ("Einsum", "Gemm", "MatMul")

_LAYOUT = frozenset(
    {
        "Cast", "Div", "Dropout", "Expand", "Flatten", "Identity", "Mul", "Reshape",
        "Squeeze", "Transpose", "Unsqueeze", "Where",
    }
)  # fmt: skip

_SCORES = _LAYOUT | {"Add", "Clip", "Max", "Min", "Neg", "Sub"}
"""What may stand between the product of queries and keys and the softmax: scale,
masks (additive or boolean), relative positions, layout."""

_WEIGHTS = _LAYOUT
"""What may stand between the softmax and the product with the values: dropout, masks,
layout."""


@dataclasses.dataclass(frozen=True)
class Attention:
    """One attention.

    Attributes:
        queries: number of query tokens; None if the shape is open.
        keys: number of key tokens; None if the shape is open.
    """

    queries: int | None
    keys: int | None

    @property
    def length(self) -> int | None:
        """The longer of the two."""
        if self.queries is None or self.keys is None:
            return None
        return max(self.queries, self.keys)


def find_attention(
    model: ir.Model, constants: Collection[ir.Value]
) -> dict[ir.Node, Attention]:
    """Map every product that takes part in an attention to that attention.

    From each softmax one walk goes back to the product of queries and keys and one
    forward to the product with the values, through scaling, masks, casts and changes of
    layout. Both products may be MatMul, Gemm or Einsum, the softmax may be decomposed
    into ``Div(Exp(x), ReduceSum(Exp(x)))``. Walks stop at every product and never enter
    a node twice: the search is linear in the size of the graph.

    Sampling weights of deformable attention come from a linear layer, not from such a
    product, and are not attention here.

    Args:
        model: the graph, shapes inferred.
        constants: values that no input changes: what multiplies one of them from the
            left is a layer, not an attention.
    """
    found: dict[ir.Node, Attention] = {}
    back = _Walk(_SCORES, constants, forward=False)
    ahead = _Walk(_WEIGHTS, constants, forward=True)
    for weights, scores in _softmaxes(model.graph):
        queries_by_keys = back.products(scores)
        if not queries_by_keys:
            continue
        attention = Attention(*_lengths(queries_by_keys[0].outputs[0]))
        for product in (*queries_by_keys, *ahead.products(weights)):
            found.setdefault(product, attention)
    return found


class _Walk:
    """Walks that share what they have seen: a node entered before is not entered."""

    def __init__(
        self,
        through: frozenset[str],
        constants: Collection[ir.Value],
        *,
        forward: bool,
    ) -> None:
        self._through = through
        self._constants = constants
        self._forward = forward
        self._seen: dict[ir.Node, list[ir.Node]] = {}

    def products(self, start: ir.Value) -> list[ir.Node]:
        """List the products that can be reached from a value, nearest first."""
        queue, mine = deque([start]), list[ir.Node]()
        while queue:
            for node in self._next(queue.popleft()):
                if node in self._seen:
                    if self._seen[node] is not mine:
                        mine += self._seen[node]
                elif self._is_product(node):
                    mine.append(node)
                elif node.op_type in self._through:
                    self._seen[node] = mine
                    ends = node.outputs if self._forward else node.inputs
                    queue.extend(end for end in ends if end is not None)
        mine[:] = dict.fromkeys(mine)
        return mine

    def _is_product(self, node: ir.Node) -> bool:
        """Say whether a node multiplies by a matrix that is computed, not a weight.

        The left one may be constant: learned queries that have not met the scene yet.
        """
        return (
            node.op_type in _PRODUCTS
            and node.domain in ("", "ai.onnx")
            and node.inputs[1] is not None
            and node.inputs[1] not in self._constants
        )

    def _next(self, value: ir.Value) -> Iterable[ir.Node]:
        if self._forward:
            return value.consumers()
        producer = value.producer()
        return () if producer is None else (producer,)


def _softmaxes(nodes: Iterable[ir.Node]) -> Iterator[tuple[ir.Value, ir.Value]]:
    """Give (weights, scores) of every softmax."""
    for node in nodes:
        if node.op_type == "Softmax" and node.inputs[0] is not None:
            yield node.outputs[0], node.inputs[0]
        elif node.op_type == "Div":
            scores = _decomposed(node)
            if scores is not None:
                yield node.outputs[0], scores


def _decomposed(division: ir.Node) -> ir.Value | None:
    """Give the x of ``Div(Exp(x), ReduceSum(Exp(x)))``."""
    above, below = division.inputs[:2]
    power = above.producer() if above is not None else None
    total = below.producer() if below is not None else None
    if power is None or total is None:
        return None
    if power.op_type != "Exp" or total.op_type != "ReduceSum":
        return None
    return power.inputs[0] if total.inputs[0] is above else None


def _lengths(scores: ir.Value) -> tuple[int | None, int | None]:
    shape = static_shape(scores)
    if shape is None or len(shape) < 2:
        return None, None
    return shape[-2], shape[-1]
