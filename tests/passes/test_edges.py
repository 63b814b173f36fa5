"""Edges that the ablation pass adds, those that do not fit, and what grows behind."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.base.errors import ModuleMapError, PreconditionError, RecipeError
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import PASSES
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.parts import Edge, propagate_size, stretched
from me2e_compress.runtime.session import run_once
from tests.passes.hoisted import integers
from tests.passes.queries import KEYS, Numbers, context, stack, weights
from tests.passes.small import read
from tests.support.profiles import scaled

CAMERA = np.random.default_rng(1).normal(size=(1, 5, 8)).astype("f")


def answers(model: ir.Model, camera: Numbers = CAMERA) -> Mapping[str, Numbers]:
    result = run_once(model, {"camera": camera})
    return {name: array.astype("f") for name, array in result.items()}


def attended(query: Numbers, keys: Numbers) -> Numbers:
    """Attention of two heads, one query [8] to keys [K, 8]."""
    heads = []
    for at in (slice(0, 4), slice(4, 8)):
        logits = keys[:, at] @ query[at]
        share = np.exp(logits - logits.max())
        heads.append((share / share.sum()) @ keys[:, at])
    return np.concatenate(heads)


def scene() -> tuple[Numbers, Numbers, Numbers]:
    """Cells [5, 8], the ego's track query [8], the planner's query [8]."""
    bev = np.tanh(CAMERA[0])
    ego = bev.mean(0)
    return bev, ego, (2 * ego + weights()["embedding"][0]).max(0)


@pytest.mark.parametrize(
    ("edges", "picks"),
    [((KEYS,), ["pick"]), ((KEYS, Edge("*.agents", "*.attn")), ["pick", "pair"])],
)
def test_appended_queries_are_read(edges: tuple[Edge, ...], picks: list[str]) -> None:
    result = AblateModules((), edges=edges).run(stack(), context())

    bev, _, query = scene()
    more = [weights()[name][0] @ bev for name in picks]
    plan = answers(result.model)["plan"][0, 0]
    np.testing.assert_allclose(plan, attended(query, np.vstack([bev, *more])), 1e-4)
    assert "*.attn reads lanes [1,3,8] behind bev [1,5,8]" in result.notes


def test_an_added_query_is_repeated_for_every_mode() -> None:
    edge = Edge("track", "planner", "add", of="motion")

    result = AblateModules((), edges=(edge,)).run(stack(), context())

    bev, ego, query = scene()
    plan = answers(result.model)["plan"][0, 0]
    np.testing.assert_allclose(plan, attended(query + ego, bev), 1e-4)


def test_a_map_says_who_reads_a_substitute() -> None:
    wanted = 'substitutes = [{ scope = "motion", by = "track", reader = "planner" }]'

    result = AblateModules(("motion",)).run(stack(), context(wanted))

    bev, ego, _ = scene()
    answer = answers(result.model)
    np.testing.assert_allclose(answer["plan"][0, 0], attended(2 * ego, bev), 1e-4)
    assert "agents reads as zeros" in result.notes


def test_a_reader_that_goes_too_gets_no_substitute() -> None:
    wanted = 'substitutes = [{ scope = "motion", by = "track", reader = "occ" }]'
    chosen = AblateModules(("motion", "occ"), drop_outputs=True)

    result = chosen.run(stack(), context(wanted))

    assert "occ is not there: nothing is substituted for it" in result.notes


def test_an_edge_keeps_the_contract_of_passes() -> None:
    """Nodes name the pass, shapes agree, the interface stays: the manager checks."""
    text = (
        'ablate-modules{drop=[motion], edges=[{source=map, reader="*.attn"},'
        " {source=track, reader=planner, how=replace, of=motion}]}"
    )
    passes = recipe.parse(f"import-normalize,{text},eliminate-redundant")

    report = PassManager(passes, verify_frames=0).run(stack(), context())

    assert answers(report.model)["plan"].shape == (1, 1, 8)
    assert {port.name for port in graph.interface(report.model)[1]} == {
        *("plan", "lanes", "taken")
    }


def test_edges_have_text() -> None:
    chosen = AblateModules(("occ",), edges=(KEYS, Edge("a", "b", "replace", "c", -2)))

    text = recipe.to_text([chosen])

    assert recipe.parse(text) == (chosen,)
    assert '{source="map", reader="*.attn"}' in text


@given(
    st.sampled_from(["track", "map", "motion", "*.agents"]),
    st.sampled_from(["occ", "*.attn", "planner", "motion"]),
    st.sampled_from(["append", "add"]),
    st.sampled_from(["plan", "lanes", "taken"]),
)
@settings(max_examples=scaled(25))
def test_what_does_not_depend_on_the_reader_stays(
    source: str, reader: str, how: str, output: str
) -> None:
    edge = PASSES.build(
        "ablate-modules",
        {"drop": [], "edges": [{"source": source, "reader": reader, "how": how}]},
    )
    behind = {"occ": {"taken"}, "motion": {"taken", "plan"}}.get(reader, {"plan"})
    try:
        result = edge.run(stack(), context())
    except PreconditionError:
        return
    if output not in behind:
        before, after = answers(stack())[output], answers(result.model)[output]
        np.testing.assert_array_equal(before, after)


@given(
    st.lists(st.integers(1, 4), min_size=1, max_size=4),
    st.lists(st.integers(1, 4), min_size=1, max_size=4),
)
def test_what_is_stretched_can_be_broadcast(have: list[int], want: list[int]) -> None:
    padded = stretched(tuple(have), tuple(want))
    if padded is not None:
        stored = np.zeros(have).reshape(padded)
        assert np.broadcast_to(stored, want).shape == tuple(want)


def test_a_broadcast_of_more_than_one_meaning_is_none() -> None:
    assert stretched((2, 8), (2, 2, 8)) == (1, 2, 8)  # numpy's own rule
    assert stretched((2, 8), (2, 2, 3, 8)) is None
    assert stretched((1, 5, 8), (1, 5, 6, 8)) == (1, 5, 1, 8)
    assert stretched((1, 8), (1, 6, 4)) is None


@pytest.mark.parametrize(
    ("edge", "message"),
    [
        (
            Edge("occ", "*.attn"),
            r"edge occ -> \*.attn: nothing that leaves occ \(taken \[1,2,5\]\) fits"
            r" what \*.attn reads \(query \[1,1,8\], bev \[1,5,8\]\)",
        ),
        (Edge("*.lidar", "*.attn"), r"the graph has no \*.lidar"),
        (Edge("map", "*.lidar"), r"\*.lidar reads nothing$"),
        (Edge("map", "planner", "add", of="occ"), "planner reads nothing of occ, only"),
        (Edge("planner", "map"), r"plan \[1,1,8\] does not fit /map/MatMul"),
        (Edge("motion", "*.attn", axis=7), "nothing that leaves motion"),
        (Edge("*.attn", "backbone", axis=1), r"plan depends on what backbone makes"),
    ],
)
def test_an_edge_that_does_not_fit_is_refused(edge: Edge, message: str) -> None:
    with pytest.raises(PreconditionError, match=message):
        AblateModules((), edges=(edge,)).run(stack(), context())


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (
            AblateModules(("backbone",), fill="zeros"),
            "without backbone the plan is cut: plan depends on nothing of backbone",
        ),
        (AblateModules(("map",), drop_outputs=True, edges=(KEYS,)), "map is dropped t"),
        (AblateModules(("planner",), drop_outputs=True), "cannot be dropped: .* plan"),
        (AblateModules(("planner",)), "planner cannot be dropped: it makes plan"),
    ],
)
def test_an_ablation_that_cuts_the_planner_or_a_source_is_refused(
    chosen: AblateModules, message: str
) -> None:
    with pytest.raises(PreconditionError, match=message):
        chosen.run(stack(), context())


def test_what_is_not_said_is_asked_for() -> None:
    with pytest.raises(RecipeError, match="drop is empty, and there are no edges"):
        AblateModules(()).run(stack(), context())
    with pytest.raises(RecipeError, match="edge a -> b: how=replace needs of=PART"):
        recipe.parse("ablate-modules{drop=[], edges=[{source=a,reader=b,how=replace}]}")
    with pytest.raises(ModuleMapError, match="a substitute with a reader needs by="):
        context('substitutes = [{ scope = "motion", reader = "planner" }]')


HEAD = '<ir_version: 9, opset_import: ["" : 17, "own" : 1]>\n'


def grown(
    shape: tuple[int, ...],
    axis: int,
    body: str,
    made: tuple[int, ...] = (1,),
    gives: str = "float y",
    b: ir.Shape | Literal["inferred"] | None = "inferred",
) -> ir.Model:
    """Let the readers of ``old`` in a body read two more along an axis instead.

    The body makes ``y`` of ``old``; ``made`` is a constant that it may read, and ``b``
    the shape that the file gives the value of that name.
    """
    more = [*shape]
    more[axis] = 2
    model = read(
        f"{HEAD}g (float{list(shape)} x, float{more} z) => ({gives}) {{\n"
        f"  old = Neg(x)  new = Concat<axis = {axis}>(old, z)  {body}\n}}",
        made=integers(*made),
    )
    graph.infer_shapes(model)
    old, new = model.graph[0].outputs[0], model.graph[1].outputs[0]
    for node in model.graph:
        if node.outputs[0].name == "b" and b != "inferred":
            node.outputs[0].shape = b
    for node, index in tuple(old.uses()):
        if node is not model.graph[1]:
            node.replace_input_with(index, new)
    propagate_size(model, new, old, "more queries")
    return model


def shape_of(model: ir.Model, name: str) -> tuple[int, ...] | None:
    return next(
        graph.static_shape(value)
        for node in model.graph
        for value in node.outputs
        if value.name == name
    )


SUM = "y = ReduceSum<keepdims = 0>(b)"


@pytest.mark.parametrize(
    ("shape", "axis", "made", "longer"),
    [
        ((1, 6, 8), 1, (1, 6, 2, 4), (1, 8, 2, 4)),
        ((1, 6, 8), 1, (6, 8), (8, 8)),
        ((4, 1, 4), 2, (4, 4, 1), (4, 6, 1)),  # the second of two that are as long
        ((4, 4, 1), 0, (4, 1, 4), (6, 1, 4)),  # the first
        ((2, 3, 6), 2, (6, 6), (6, 8)),
        ((6, 2, 3), 0, (6, 6), (8, 6)),
    ],
)
def test_a_reshape_gets_longer_where_the_axis_stands_in_its_result(
    shape: tuple[int, ...], axis: int, made: tuple[int, ...], longer: tuple[int, ...]
) -> None:
    model = grown(shape, axis, f"b = Reshape(old, made) {SUM}", made)

    assert shape_of(model, "b") == longer


RESHAPED = f"b = Reshape(old, made) {SUM}"
UNKNOWN = "c = Cast<to = 1>(b)  y = ReduceSum(c)"


@pytest.mark.parametrize(
    ("shape", "body", "options", "message"),
    [
        ((1, 6, 8), RESHAPED, {"made": (1, 48)}, "the queries are no axis of that"),
        ((1, 6, 8), RESHAPED, {"made": (3, 2, 8)}, "the queries are no axis of that"),
        ((2, 6, 4), RESHAPED, {"made": (6, 8)}, "the queries are no axis of that"),
        ((1, 6, 8), f"b = own.Plugin(old) {SUM}", {}, "does not fit n2 "),
        ((1, 6, 8), f"b = Add(old, x) {SUM}", {}, r"does not fit n2 \(Add\)"),
        (
            (1, 6, 8),
            "y = Relu(old)",  # an output of the graph stays as it is
            {"gives": "float[1,6,8] y"},
            r"would change y \[1,6,8\]",
        ),
        # a size that is not known after, or before
        (
            (1, 6, 8),
            f"b = NonZero(old) {UNKNOWN}",
            {"b": ir.Shape([3, 48])},
            "would change b ",
        ),
        ((1, 6, 8), f"b = Relu(old) {UNKNOWN}", {"b": None}, "would change b "),
    ],
)
def test_what_cannot_read_more_is_refused(
    shape: tuple[int, ...], body: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(PreconditionError, match=message):
        grown(shape, 1, body, **options)
