"""The search: int8 modules within budgets, and what is said when nothing fits."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import EvaluationError
from me2e_compress.fidelity.sensitivity import (
    Budget,
    Candidate,
    Int8Choice,
    nothing_fits,
    search,
)
from me2e_compress.workflows.search import SearchResult
from tests.fidelity.sensitivity.delicate import trials


def weight_bytes(made: ir.Model) -> float:
    return float(graph.size(made).weight_bytes)


def test_the_search_keeps_the_budget_and_loses_least(tmp_path: Path) -> None:
    judge = trials(tmp_path, 3)
    whole = weight_bytes(judge.model)
    only_backbone = weight_bytes(judge.variant(Int8Choice(("backbone",))))
    only_head = weight_bytes(judge.variant(Int8Choice(("head",))))

    loose, tight, tighter = (
        search(judge, ("backbone", "head"), [Budget(limit, "bytes", weight_bytes)])
        for limit in (whole, only_backbone, only_head)
    )

    assert loose[-1].modules == ()
    assert tight[-1].modules == ("backbone",)
    assert tighter[-1].modules == ("head",)
    for each in (loose[-1], tight[-1], tighter[-1]):
        assert each.score is not None
        assert each.measured_costs is not None
    assert tight[-1].measured_costs == (only_backbone,)


def test_the_last_that_is_tried_is_the_cheapest(tmp_path: Path) -> None:
    judge, both = trials(tmp_path, 3), ("backbone", "head")
    whole = weight_bytes(judge.model)
    least = weight_bytes(judge.variant(Int8Choice(both)))
    weighed: list[float] = []

    def cost(made: ir.Model) -> float:  # once all are predicted, only both stay cheap
        weighed.append(weight_bytes(made))
        return weighed[-1] + (whole if len(weighed) > 3 and weighed[-1] > least else 0)

    found = search(judge, both, [Budget(whole, "bytes", cost)], most_tried=2)

    assert [each.modules for each in found] == [(), both]


def test_a_budget_that_nothing_fits_is_an_error(tmp_path: Path) -> None:
    judge = trials(tmp_path, 3)
    with pytest.raises(EvaluationError, match=r"nothing fits 10 bytes: the float"):
        search(judge, ("backbone", "head"), [Budget(10, "bytes", weight_bytes)])


def test_every_one_of_several_budgets_is_kept(tmp_path: Path) -> None:
    judge = trials(tmp_path, 3)
    size = Budget(weight_bytes(judge.model), "bytes", weight_bytes)
    float_head = weight_bytes(judge.variant(Int8Choice(("backbone",))))
    nodes = Budget(float_head - 1, "other bytes", weight_bytes)

    found = search(judge, ("backbone", "head"), [size, nodes])
    both = [size, Budget(1, "s", lambda _: 2.0)]

    assert found[-1].measured_costs is not None
    assert found[-1].modules == ("head",)
    message = (
        r"nothing fits [\d,]+ bytes and 1 s: .*least found is .* and 2 s; each alone"
    )
    with pytest.raises(EvaluationError, match=message):
        search(judge, ("backbone", "head"), both)


def test_what_fits_nothing_is_told_without_powers_of_ten() -> None:
    size = Budget(1e5, "bytes", weight_bytes)
    said = nothing_fits([size], [6_142_060.0], [[4_778_000.0]])

    assert said == (
        "nothing fits 100,000 bytes: the float model costs 6,142,060 bytes, the least"
        " found is about 4,778,000 bytes"
    )


def test_a_search_shows_bytes_as_they_are() -> None:
    tried = Candidate(("neck",), 5.4e-05, (1.0,), None, (4_746_123.0,))
    found = SearchResult(Path("s.toml"), (tried,), (("bytes", 4_778_000.0),), "")

    (table,) = found.tables()
    assert [cell.text for cell in table.rows[0][1:]] == ["-", "0.000054", "4,746,123"]
    assert table.note == "budget: 4,778,000 bytes"
