"""Folding computes nothing that is larger than it may be."""

from collections.abc import Sequence

import onnx_ir as ir
import pytest

from me2e_compress.graph import static_shape
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.graph.rewrite import Array
from me2e_compress.passes import Context
from me2e_compress.passes.fold_constants import (
    FoldConstants,
    evaluation,
    knowledge,
)
from me2e_compress.passes.fold_constants.evaluation import Knowledge
from me2e_compress.runtime.opening import REFUSALS


def test_a_value_beyond_the_limit_stays_computed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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

    monkeypatch.setattr(evaluation, "evaluate", evaluate)
    found = FoldConstants(bytes_per_node=0).run(model, Context(ModuleMap.whole())).model
    assert max(rows) * 16 == knowledge.LARGEST
    assert [node.op_type for node in found.graph][-2:] == ["ReduceMax", "Add"]


def test_memory_that_runs_out_is_a_refusal() -> None:
    assert issubclass(MemoryError, REFUSALS)
