"""A fault is told from rounding, from what a pass moved, and from what nobody reads."""

import numpy as np
import onnx_ir as ir
import pytest

from benchmarks.wrong_nodes import seed_fault
from me2e_compress import graph
from me2e_compress.errors import Me2eError
from me2e_compress.fidelity.first_difference import FirstDifference, Source
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.manager import recipe
from me2e_compress.manager.pass_manager import PassManager
from me2e_compress.runtime.frames import Frame
from tests.fuzz.exact.drawing import draw
from tests.fuzz.exact.judging import Case
from tests.fuzz.exact.running import drawn_inputs

HIDDEN = """
<ir_version: 9, opset_import: ["" : 17]>
hidden (float[1,8] x) => (float[1,8] y) <float one = {1.0}, float zero = {0.0}> {
    ["a"] low = %s(x)
    ["b"] shifted = Add(low, one)
    ["c"] gone = Mul(shifted, zero)
    ["d"] y = Add(x, gone)
}
"""


def test_what_never_reaches_an_output_is_told_apart() -> None:
    frames = [Frame(0, True, {"x": np.ones((1, 8), np.float32)})]
    source = Source.of(ir.from_onnx_text(HIDDEN % "Sigmoid"), frames)

    found = source.first_difference(ir.from_onnx_text(HIDDEN % "Tanh"))

    assert found.first is None
    assert not found.outputs_differ
    assert next(each.nodes for each in found.places) == ("a",)


def test_what_reaches_an_output_comes_first() -> None:
    frames = [Frame(0, True, {"x": np.ones((1, 8), np.float32)})]
    source = Source.of(ir.from_onnx_text(HIDDEN % "Sigmoid"), frames)
    text = (HIDDEN % "Tanh").replace("Add(x, gone)", "Div(x, gone)")

    found = source.first_difference(ir.from_onnx_text(text))

    assert [each.nodes for each in found.places] == [("d",)]


GROWN = """
<ir_version: 9, opset_import: ["" : 17]>
grown (float[1,64] x) => (float[1,64] y)
<float nearly_one = {%s}, float big = {1e6}> {
    ["a"] same = Mul(x, nearly_one)
    ["b"] large = Mul(same, big)
    ["c"] wave = Sin(large)
    ["d"] y = Exp(wave)
}
"""


def test_rounding_that_grew_is_no_fault() -> None:
    x = np.random.default_rng(0).standard_normal((1, 64)).astype(np.float32)
    frames = [Frame(0, True, {"x": x})]
    source = Source.of(ir.from_onnx_text(GROWN % "1.0"), frames)

    found = source.first_difference(ir.from_onnx_text(GROWN % "1.000001"))

    assert found.outputs_differ
    assert found.places == ()
    assert found.inherited == 2


MISSING = """
<ir_version: 9, opset_import: ["" : 17]>
missing (float[1,8] x) => (float[1,8] y) {
    ["tanh"] t = Tanh(x)
    ["relu"] r = %s(t)
    ["exp"] y = Exp(r)
}
"""


def test_a_lost_node_is_found_although_its_value_equals_another() -> None:
    x = np.random.default_rng(0).standard_normal((1, 8)).astype(np.float32)
    source = Source.of(ir.from_onnx_text(MISSING % "Relu"), [Frame(0, True, {"x": x})])

    (place,) = source.first_difference(ir.from_onnx_text(MISSING % "Identity")).places

    assert place.nodes == ("relu",)


FACTOR = """
<ir_version: 9, opset_import: ["" : 17]>
factor (float[4,8] x) => (float[4,8] y)
<float[8] w = {%s}, int64[3] form = {2, 2, 8}, float[8] halves = {%s}> {
    ["first"] a = Mul(x, w)
    ["bias"] b = Relu(a)
    ["shape"] c = Reshape(b, form)
    %s
    ["last"] e = %s(d)
    ["sum"] y = ReduceSum<keepdims=0>(e)
}
"""


def factor(*, moved: bool, last: str = "Exp") -> ir.Model:
    """Multiply by a factor a column, behind a Reshape, or in the weights before it."""
    halves = [0.5, 0.25] * 4
    weights = [(each + 1.0) * (by if moved else 1.0) for each, by in enumerate(halves)]
    scale = '["scale"] d = %s(c, halves)' % ("Add" if moved else "Mul")
    numbers = [", ".join(map(str, each)) for each in (weights, halves)]
    model = ir.from_onnx_text(FACTOR % (*numbers, scale, last))
    for each in model.graph:
        name = str(each.name)
        origins = (name, "scale") if moved and name in ("first", "bias") else (name,)
        provenance.stamp(each, Provenance("head", origins))
    if moved:  # the factor is in the weights now
        scaled = model.graph.node("scale")
        model.graph.node("last").replace_input_with(0, scaled.inputs[0])
        model.graph.remove(scaled, safe=True)
    return model


@pytest.mark.parametrize("last", ["Exp", "Sigmoid"])
def test_a_factor_that_a_pass_moved_is_no_fault(last: str) -> None:
    x = np.random.default_rng(0).standard_normal((4, 8)).astype(np.float32)
    source = Source.of(factor(moved=False), [Frame(0, True, {"x": x})])

    found = source.first_difference(factor(moved=True, last=last))

    named = [each.nodes for each in found.places]
    assert named == ([] if last == "Exp" else [("last",)])


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("first", range(0, 24, 6))
def test_faults_in_drawn_graphs_are_found(first: int, exact: bool) -> None:
    for seed in range(first, first + 6):
        case = Case(draw(seed), seed)
        feeds = [
            drawn_inputs(case.answers.runner, seed + at, case.sizes[0]) for at in (0, 1)
        ]
        candidate = case.imported.clone()
        if exact:
            passes = recipe.parse("fold-constants,eliminate-redundant,fuse-basic")
            manager = PassManager(passes, verify_frames=0)
            candidate = manager.run(candidate, case.context).model
        try:
            source = Source.of(
                case.imported, [Frame(at, True, each) for at, each in enumerate(feeds)]
            )
            assert source.first_difference(candidate).first is None, seed
            for value in candidate.graph.inputs:
                value.shape = ir.Shape(feeds[0][str(value.name)].shape)
            graph.infer_shapes(candidate)
            fault = seed_fault(candidate, seed)
            found = source.first_difference(candidate)
        except (Me2eError, ValueError):
            continue  # nothing is computed, or no fault fits
        assert _names(found, fault.nodes), (seed, fault)


def _names(found: FirstDifference, nodes: tuple[str, ...]) -> bool:
    first = found.first or next(iter(found.places), None)
    return not found.different or (
        first is not None and bool(set(nodes) & set(first.nodes))
    )
