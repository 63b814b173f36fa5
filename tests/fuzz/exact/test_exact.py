"""Exact means exact, on drawn graphs; ``make nightly`` draws many more."""

import collections

import pytest

from me2e_compress.passes import PASSES
from tests.fuzz.exact.drawing import MOTIFS, draw, drawing
from tests.fuzz.exact.judging import Case, judged, report
from tests.fuzz.exact.pipelines import SLOW, int8_ways, some_for

FIRST, GRAPHS, PARTS = 1000, 100, 2
DRAWN, SEARCHED = 200, 300
LEAST_MOTIF, LEAST_PASS = 3, 1
"""How often each must be seen among so many graphs."""

FAULTY = (700249, 821977)
"""Seeds of graphs in which a night found a fault."""

INVALID = 0.01
"""The part of drawn graphs that may turn out not to run."""


@pytest.mark.parametrize("part", range(PARTS))
def test_exact_passes_keep_what_drawn_graphs_compute(part: int) -> None:
    seen = collections.Counter[str]()
    size = GRAPHS // PARTS
    seeds = range(FIRST + part * size, FIRST + (part + 1) * size)
    for seed in (*seeds, *FAULTY[part::PARTS]):
        model = draw(seed)
        for each in judged(seed, model, some_for(model, seed)):
            seen[each.kind] += 1
            if each.is_bad:
                pytest.fail(report(seed, each))
    assert seen["invalid-draw"] <= INVALID * size
    assert seen["right"] > size
    assert seen["unstable"] <= 0.01 * seen.total()


def test_every_motif_is_drawn() -> None:
    seen = collections.Counter(
        motif
        for seed in range(FIRST, FIRST + DRAWN)
        for motif in set(drawing(seed).motifs)
    )
    rare = {name: seen[name] for name in MOTIFS if seen[name] < LEAST_MOTIF}
    assert not rare


def test_every_exact_pass_finds_something_to_do() -> None:
    """On the first graphs it is enough that each changes one."""
    seen = collections.Counter[str]()
    wanted = {
        name for name in PASSES.names() if PASSES.get(name).exact and name not in SLOW
    }
    missing = wanted
    for seed in range(SEARCHED):
        missing = {name for name in wanted if seen[name] < LEAST_PASS}
        if not missing:
            break
        model = draw(seed)
        case = Case(model, seed)
        for text in some_for(model, seed):
            if missing & {word.partition("{")[0] for word in text.split(", ")}:
                changes = case.judge(text).changes
                seen.update({name for name, count in changes if count})
    assert not missing, seen


def test_a_seed_gives_the_same_bytes() -> None:
    for seed in range(10):
        assert draw(seed).SerializeToString() == draw(seed).SerializeToString()


@pytest.mark.parametrize("seed", [21, 58, 128, 169])
def test_int8_keeps_the_graph(seed: int) -> None:
    """Of graphs that have something to quantize, each way."""
    model = draw(seed)
    for found in judged(seed, model, list(int8_ways(model, seed))):
        assert found.kind == "right", found
