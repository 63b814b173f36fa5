"""Sequences that a graph only takes apart again become plain operators."""

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress.graph import infer_shapes, provenance
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.passes import Context
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.runtime.session import run_once
from tests.passes.small import ops


def graph_of(body: str) -> ir.Model:
    return ir.from_onnx_text(
        f"""<ir_version: 9, opset_import: ["" : 17, "other" : 1]>
        g (float[2,6] x) => (y) <
            int64 zero = {{0}}, int64 last = {{-1}}, int64 four = {{4}},
            int64[2] parts = {{2, 4}}, float[1,6] stored = {{1, 2, 3, 4, 5, 6}}
        > {{ {body} }}"""
    )


def normalise(model: ir.Model) -> None:
    ImportNormalize().run(model, Context(ModuleMap.whole()))


@pytest.mark.parametrize(
    "body",
    [
        '["s"] s = SplitToSequence<axis = 1>(x, parts) ["y"] y = SequenceAt(s, last)',
        '["s"] s = SplitToSequence<axis = -1>(x, four) ["y"] y = SequenceAt(s, last)',
        '["s"] s = SplitToSequence<axis = -1>(x, four) ["y"] y = ConcatFromSequence'
        "<axis = 1>(s)",
        '["s"] s = SplitToSequence(x) ["y"] y = SequenceAt(s, zero)',
        '["s"] s = SequenceConstruct(stored, x) ["y"] y = SequenceLength(s)',
        '["n"] n = Neg(x) ["s"] s = SequenceConstruct(x, n)'
        ' ["y"] y = ConcatFromSequence<axis = 1>(s)',
        '["n"] n = Neg(x) ["s"] s = SequenceConstruct(x, n)'
        ' ["y"] y = ConcatFromSequence<axis = -1, new_axis = 1>(s)',
    ],
)
def test_a_sequence_becomes_its_tensors(body: str) -> None:
    model = graph_of(body)
    feeds = {"x": np.arange(12, dtype=np.float32).reshape(2, 6)}
    before = run_once(model, feeds)["y"]
    normalise(model)
    np.testing.assert_array_equal(run_once(model, feeds)["y"], before)
    assert not any("Sequence" in node.op_type for node in model.graph)


@pytest.mark.parametrize(
    "body",
    [
        '["s"] s = SplitToSequence<keepdims = 0>(x) ["y"] y = SequenceAt(s, zero)',
        '["s"] s = SequenceConstruct(x) ["t"] t = SequenceInsert(s, x)'
        ' ["y"] y = SequenceAt(t, last)',
        '["s"] s = SplitToSequence<axis = 1>(stored, parts)'
        ' ["y"] y = SequenceAt(s, last)',
        '["s"] s = SplitToSequence(x) ["y"] y = SequenceAt(s, four)',
        '["y"] y = SequenceConstruct(x, x) ["n"] n = SequenceLength(y)',
        '["y"] y = Neg(x) ["s"] s = SequenceConstruct(x, y)',
        '["s"] s = SplitToSequence(x, zero) ["y"] y = SequenceAt(s, zero)',
        '["s"] s = other.SequenceConstruct(x) ["y"] y = SequenceAt(s, zero)',
        '["s"] s = SequenceConstruct(x, x) ["n"] n = SequenceLength(s)'
        ' ["t"] t = SequenceErase(s) ["y"] y = SequenceAt(t, zero)',
    ],
)
def test_other_sequences_stay(body: str) -> None:
    model = graph_of(body)
    before = ops(model)
    normalise(model)
    assert ops(model) == before


BODIES = """<ir_version: 9, opset_import: ["" : 17]>
    g (bool c, float[2,6] x) => (float[2,4] y) <
        int64[2] parts = {2, 4}, int64 one = {1}, float[1] s_lengths = {1}
    > {
    ["/whole"] whole = SplitToSequence<axis = 1>(x, parts)
    ["/s_Split_0"] s_Split_0 = Neg(x)
    ["/if"] y = If(c) <then_branch = t () => (float[2,4] a) {
        ["s"] s = SplitToSequence<axis = 1>(s_Split_0, parts)
        ["/at"] at = SequenceAt(s, one)
        ["/length"] length = SequenceLength(s)
        ["/cast"] wide = Cast<to = 1>(length)
        ["/mul"] scaled = Mul(at, wide)
        ["/a"] a = Mul(scaled, s_lengths)
    }, else_branch = e () => (float[2,4] b) {
        ["/outer"] outer = SequenceAt(whole, one)
        ["/joined"] pair = SequenceConstruct(outer, outer)
        ["/stack"] stacked = ConcatFromSequence<axis = 0, new_axis = 1>(pair)
        ["/b"] b = ReduceMax<axes = [0], keepdims = 0>(stacked)
    }>
}"""


@pytest.mark.parametrize("taken", [True, False])
def test_bodies_too_have_tensors_with_a_type_a_name_and_a_past(taken: bool) -> None:
    model = ir.from_onnx_text(BODIES)
    infer_shapes(model)
    for node in model.graph.all_nodes():
        own = provenance.Provenance("planner", (str(node.name),))
        provenance.stamp(node, own)
    feeds = {"c": np.array(taken), "x": np.arange(12, dtype=np.float32).reshape(2, 6)}
    before = run_once(model, feeds)["y"]

    normalise(model)

    onnx.checker.check_model(ir.to_proto(model), full_check=True)
    np.testing.assert_array_equal(run_once(model, feeds)["y"], before)
    made = {
        f"{node.op_type} of {past.origins[0]}": past
        for node in model.graph.all_nodes()
        if (past := provenance.read(node)) is not None
        and past.passes == ("import-normalize",)
    }
    assert {past.module for past in made.values()} == {"planner"}
    # a new axis is put into both tensors of the pair
    assert list(made) == [
        "Split of /whole", "Split of s", "Identity of /at", "Identity of /length",
        "Identity of /outer", "Unsqueeze of /stack", "Concat of /stack",
    ]  # fmt: skip
    splits = [node for node in model.graph.all_nodes() if node.op_type == "Split"]
    types = {value.dtype for node in splits for value in node.outputs}
    assert types == {ir.DataType.FLOAT}
