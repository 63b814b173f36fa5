"""Edges that the ablation pass adds, and broadcasts."""

from collections.abc import Mapping

import numpy as np
import onnx_ir as ir
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.errors import PreconditionError
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import PASSES
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.edges import Edge
from me2e_compress.passes.parts import stretched
from me2e_compress.runtime.session import run_once
from tests.passes.queries import KEYS, Numbers, context, stack, weights
from tests.profiles import scaled

CAMERA = np.random.default_rng(1).normal(size=(1, 5, 8)).astype("f")


def answers(model: ir.Model, camera: Numbers = CAMERA) -> Mapping[str, Numbers]:
    found = run_once(model, {"camera": camera})
    return {name: array.astype("f") for name, array in found.items()}


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


def test_appended_queries_are_attended_to() -> None:
    result = AblateModules((), edges=(KEYS,)).run(stack(), context())

    bev, _, query = scene()
    lanes = weights()["pick"][0] @ bev
    plan = answers(result.model)["plan"][0, 0]
    np.testing.assert_allclose(plan, attended(query, np.vstack([bev, lanes])), 1e-4)
    told = "*.attn reads lanes [1,3,8] behind bev [1,5,8]"
    assert told in result.notes


def test_several_edges_end_at_one_reader() -> None:
    both = (KEYS, Edge("*.agents", "*.attn"))

    result = AblateModules((), edges=both).run(stack(), context())

    bev, _, query = scene()
    more = [weights()[name][0] @ bev for name in ("pick", "pair")]
    plan = answers(result.model)["plan"][0, 0]
    np.testing.assert_allclose(plan, attended(query, np.vstack([bev, *more])), 1e-4)


def test_an_added_query_is_repeated_for_every_mode() -> None:
    edge = Edge("track", "planner", "add", of="motion")

    result = AblateModules((), edges=(edge,)).run(stack(), context())

    bev, ego, query = scene()
    plan = answers(result.model)["plan"][0, 0]
    np.testing.assert_allclose(plan, attended(query + ego, bev), 1e-4)


def test_a_track_query_is_broadcast_in_the_place_of_six_modes() -> None:
    edge = Edge("track", "planner", "replace", of="motion")
    chosen = AblateModules(("motion",), fill="zeros", edges=(edge,))

    result = chosen.run(stack(), context())

    bev, ego, _ = scene()
    answer = answers(result.model)
    np.testing.assert_allclose(answer["plan"][0, 0], attended(2 * ego, bev), 1e-4)
    assert "planner reads ego [1,8] in the place of modes [1,6,8]" in result.notes
    assert not answer["taken"].any()  # occupancy reads motion's agents as zeros


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


def test_minus_occupancy_leaves_the_plan_bit_identical() -> None:
    result = AblateModules(("occ",), drop_outputs=True).run(stack(), context())

    np.testing.assert_array_equal(
        answers(result.model)["plan"], answers(stack())["plan"]
    )


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


def test_edges_have_text_and_toml() -> None:
    chosen = AblateModules(("occ",), edges=(KEYS, Edge("a", "b", "replace", "c", -2)))

    text, toml = recipe.to_text([chosen]), recipe.to_toml([chosen])

    assert recipe.parse(text) == (chosen,)
    assert '{source="map", reader="*.attn"}' in text
    assert '{"source" = "map", "reader" = "*.attn"}' in toml


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
        held = np.zeros(have).reshape(padded)
        assert np.broadcast_to(held, want).shape == tuple(want)


def test_a_broadcast_of_more_than_one_meaning_is_none() -> None:
    assert stretched((2, 8), (2, 2, 8)) == (1, 2, 8)  # numpy's own rule
    assert stretched((2, 8), (2, 2, 3, 8)) is None
    assert stretched((1, 5, 8), (1, 5, 6, 8)) == (1, 5, 1, 8)
    assert stretched((1, 8), (1, 6, 4)) is None
