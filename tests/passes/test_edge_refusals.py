"""Edges and ablations that do not fit are refused, and what does not fit is named."""

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.errors import ModuleMapError, PreconditionError, RecipeError
from me2e_compress.manager import recipe
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.edges import Edge
from tests.nets import net
from tests.passes.queries import KEYS, STACK, context, stack, weights


@pytest.mark.parametrize(
    ("edge", "message"),
    [
        (
            Edge("occ", "*.attn"),
            r"edge occ -> \*.attn: nothing that leaves occ \(taken \[1,2,5\]\) fits"
            r" what \*.attn reads \(query \[1,1,8\], bev \[1,5,8\]\)",
        ),
        (Edge("*.lidar", "*.attn"), r"the graph has no \*.lidar"),
        (Edge("map", "*.lidar"), r"\*.lidar reads nothing"),
        (Edge("map", "planner", "add", of="occ"), "planner reads nothing of occ, only"),
        (Edge("planner", "map"), r"plan \[1,1,8\] does not fit /map/MatMul"),
        (Edge("motion", "*.attn", axis=7), "nothing that leaves motion"),
        (Edge("*.attn", "backbone", axis=1), r"plan depends on what backbone makes"),
    ],
)
def test_an_edge_that_does_not_fit_is_refused(edge: Edge, message: str) -> None:
    with pytest.raises(PreconditionError, match=message):
        AblateModules((), edges=(edge,)).run(stack(), context())


def test_a_longer_value_that_breaks_an_operator_is_named() -> None:
    """Positions of the cells are added to the keys: there are none of the lanes."""
    text = STACK.replace("Reshape(bev, cut)", "Reshape(placed, cut)").replace(
        '["/planner/attn/Reshape_1"]',
        '["/planner/attn/Add"] placed = Add(bev, places)\n["/planner/attn/Reshape_1"]',
    )
    text = text.replace("float[1,2,5] pair)", "float[1,2,5] pair, float[1,5,8] places)")
    model = net(text, {**weights(), "places": np.ones((1, 5, 8), "f")})
    graph.infer_shapes(model)

    with pytest.raises(
        PreconditionError,
        match=r"lanes \[1,3,8\] does not fit /planner/attn/Add \(Add\), which reads"
        r" bev_joined \[1,8,8\], places \[1,5,8\]",
    ):
        AblateModules((), edges=(KEYS,)).run(model, context())


def test_queries_that_a_reshape_merges_are_refused() -> None:
    text = STACK.replace("int64[4] cut = {1, 5, 2, 4}", "int64[4] cut = {1, 10, 1, 4}")
    text = text.replace("<perm = [0, 2, 3, 1]> (k0)", "<perm = [0, 2, 3, 1]> (k1)")
    text = text.replace("<perm = [0, 2, 1, 3]> (k0)", "<perm = [0, 2, 1, 3]> (k1)")
    text = text.replace(
        '["/planner/attn/Transpose_1"]',
        '["/planner/attn/Reshape_3"] k1 = Reshape(k0, again)\n'
        '["/planner/attn/Transpose_1"]',
    ).replace("int64[3] back", "int64[4] again = {1, 5, 2, 4}, int64[3] back")
    model = net(text, weights())
    graph.infer_shapes(model)

    with pytest.raises(PreconditionError, match=r"Reshape_1, which makes \[1, 10, 1,"):
        AblateModules((), edges=(KEYS,)).run(model, context())


def test_a_source_that_is_dropped_is_refused() -> None:
    chosen = AblateModules(("map",), drop_outputs=True, edges=(KEYS,))

    with pytest.raises(PreconditionError, match="map is dropped too"):
        chosen.run(stack(), context())


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (
            AblateModules(("backbone",), fill="zeros"),
            "without backbone the plan is cut: plan depends on nothing of backbone",
        ),
        (AblateModules(("planner",), drop_outputs=True), "cannot be dropped: .* plan"),
        (AblateModules(("planner",)), "planner cannot be dropped: it makes plan"),
    ],
)
def test_an_ablation_that_cuts_the_planner_is_refused(
    chosen: AblateModules, message: str
) -> None:
    with pytest.raises(PreconditionError, match=message):
        chosen.run(stack(), context())


def test_nothing_to_do_is_refused() -> None:
    with pytest.raises(RecipeError, match="drop is empty, and there are no edges"):
        AblateModules(()).run(stack(), context())


def test_an_edge_that_replaces_says_what() -> None:
    with pytest.raises(RecipeError, match="edge a -> b: how=replace needs of=PART"):
        recipe.parse("ablate-modules{drop=[], edges=[{source=a,reader=b,how=replace}]}")


def test_a_substitute_for_a_reader_says_by_what() -> None:
    with pytest.raises(ModuleMapError, match="a substitute with a reader needs by="):
        context('substitutes = [{ scope = "motion", reader = "planner" }]')
