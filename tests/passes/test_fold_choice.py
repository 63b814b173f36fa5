"""What folding stores and what it leaves: bytes of the file against nodes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.graph import static_shape
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.nodes import Array
from me2e_compress.passes import Context
from me2e_compress.passes.fold_constants import FoldConstants, knowledge
from me2e_compress.passes.fold_constants.knowledge import Knowledge
from me2e_compress.runtime.session import REFUSALS
from tests.passes.small import apply, compute, file_bytes, ops, read


def attention(tokens: int) -> ir.Model:
    """A self-attention of learned queries: constant, its result larger than they are.

    Its packed projection is cut into three, each turned, as torch exports it.
    """
    lines = []
    for place, part in enumerate("qkv"):
        lines += [
            f"{part}_cut = Slice(packed, at_{place}, at_{place + 1}, axis)",
            f"{part}_turned = Transpose<perm = [1, 0]>({part}_cut)",
            f"{part} = MatMul(queries, {part}_turned)",
        ]
    body = "\n".join(lines)
    text = (
        f"g (float[{tokens},32] x) => (float[{tokens},32] y, float[{tokens},32] z) {{"
        f" queries = Expand(learned, shape) {body}"
        " k_again = Transpose<perm = [1, 0]>(k) scores = MatMul(q, k_again)"
        " mixed = Softmax(scores) out = MatMul(mixed, v) y = Add(x, out)"
        " moved = Mul(x, x) z = MatMul(moved, q_turned) }"
    )
    random = np.random.default_rng(0)
    return read(
        text,
        learned=random.normal(size=(1, 32)).astype(np.float32),
        shape=np.array([tokens, 32]),
        packed=random.normal(size=(96, 32)).astype(np.float32),
        axis=np.array([0]),
        **{f"at_{place}": np.array([32 * place]) for place in range(4)},
    )


@given(st.integers(0, 40_000), st.integers(2, 800))
def test_weights_grow_by_at_most_the_limit_per_node(limit: int, tokens: int) -> None:
    model = attention(tokens)
    before, nodes = file_bytes(model), len(model.graph)

    apply(FoldConstants(limit), model)

    assert file_bytes(model) - before <= limit * (nodes - len(model.graph))
    assert ops(model).count("Slice") == 0  # what shrinks the weights is done


def test_an_attention_of_constants_is_folded_within_the_limit_alone() -> None:
    """Its result is 256 kB for 13 nodes."""
    small, large = attention(2000), attention(2000)

    apply(FoldConstants(), small)
    apply(FoldConstants(bytes_per_node=20_000), large)

    assert "Softmax" in ops(small)
    assert ops(large) == ["Add", "Mul", "MatMul"]


TABLE = """
g (float[1000,64] x) => (float[1000,64] y) {
    table = Expand(row, shape)
    shifted = Add(table, one)
    y = Mul(x, shifted)
}
"""
TABLE_WEIGHTS: dict[str, Any] = {
    "row": np.arange(64, dtype=np.float32),
    "shape": np.array([1000, 64]),
    "one": np.ones(1, np.float32),
}


@pytest.mark.parametrize(
    ("limit", "left"), [(4096, ["Expand", "Add", "Mul"]), (200_000, ["Mul"])]
)
def test_a_high_limit_stores_a_repeated_table(limit: int, left: list[str]) -> None:
    model = read(TABLE, **TABLE_WEIGHTS)
    result = apply(FoldConstants(limit), model)
    assert ops(model) == left
    assert ("smaller than their values" in result.notes[0]) == (limit == 4096)


def test_a_weight_that_only_dead_nodes_share_is_free_to_fold() -> None:
    text = """
    g (float[2,3] x) => (float[2,3] y) {
        dead = Add(weight, x)
        negated = Neg(weight)
        y = Add(negated, x)
    }
    """
    model = read(text, weight=np.ones((2, 3), np.float32))
    apply(FoldConstants(bytes_per_node=0), model)
    assert ops(model) == ["Add"]


def graph_with(start: Any, limit: Any, delta: Any, kind: str = "int64") -> Any:
    text = f"""
    g ({kind}[1] x) => ({kind}[N] y) {{ r = Range(a, b, c) y = Add(x, r) }}
    """
    return read(text, a=start, b=limit, c=delta)


@pytest.mark.parametrize(
    ("start", "limit", "delta", "kind"),
    [
        *((0, 5, 2, "int64"), (5, 0, -2, "int64"), (3, 3, 1, "int64")),
        *((0, 3, -1, "int64"), (0, 100, 0.1, "float")),
    ],
)
def test_a_range_is_that_of_the_runtime_to_the_bit(
    start: int, limit: int, delta: float, kind: str
) -> None:
    number = np.float32 if kind == "float" else np.int64
    ends = number(start), number(limit), number(delta)
    before, after = graph_with(*ends, kind), graph_with(*ends, kind)

    apply(FoldConstants(bytes_per_node=10**6), after)

    feeds = {"x": np.zeros(1, number)}
    assert ops(after) == ["Add"]
    np.testing.assert_array_equal(compute(after, feeds)[0], compute(before, feeds)[0])
    endless = graph_with(number(0), number(5), number(0), kind)
    assert apply(FoldConstants(), endless).changes == 0  # the runtime refuses it


def test_a_value_beyond_the_limit_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [f"c{at + 1} = Concat<axis = 0>(c{at}, c{at})" for at in range(40)]
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "g (float[1,4] x) => (float[1,4] y) <float[1,4] c0 = {1, 1, 1, 1}> {"
        f" {' '.join(lines)} r = ReduceMax<axes = [0], keepdims = 1>(c40)"
        " y = Add(x, r) }"
    )
    rows = list[int]()

    def evaluate(
        values: Sequence[ir.Value], known: Knowledge, opset: int
    ) -> tuple[dict[ir.Value, Array], list[ir.Node]]:
        made = [one.nodes[0].outputs[0] for one in known.expressions]
        rows.extend((static_shape(each) or (0,))[0] for each in made)
        return {}, []

    monkeypatch.setattr(knowledge, "evaluate", evaluate)
    result = (
        FoldConstants(bytes_per_node=0).run(model, Context(ModuleMap.whole())).model
    )
    assert max(rows) * 16 == knowledge.LARGEST
    assert [node.op_type for node in result.graph][-2:] == ["ReduceMax", "Add"]


def test_memory_that_runs_out_is_a_refusal() -> None:
    assert issubclass(MemoryError, REFUSALS)
