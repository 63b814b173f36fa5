import dataclasses
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import EvaluationError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.search import SearchResult
from me2e_compress.fidelity.compare import Displacement, Fidelity, Reference
from me2e_compress.fidelity.sensitivity import (
    Budget,
    Candidate,
    Int8Choice,
    Score,
    Trials,
    advise,
    analyse,
    budget_message,
    int8_names,
    search,
    write_recipe,
)
from me2e_compress.manager import recipe
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session
from tests.fidelity.sensitivity.delicate import delicate, trials
from tests.support.nets import MODULES, parsed


@pytest.mark.parametrize("bad", [2, 3, 5])
def test_halves_of_the_worst_module_find_the_guilty_node(
    tmp_path: Path, bad: int
) -> None:
    found = analyse(trials(tmp_path, bad), ("backbone", "head"))

    worst, other = found.findings
    assert worst.module == "head"
    assert worst.nodes == 4
    assert [node for node, _ in worst.blamed] == [f"/head/MatMul_{bad}"]
    assert not other.blamed
    assert found.trials == 2 + 4 + 1
    assert worst.score.loss > 5 * other.score.loss
    assert worst.score.unit == "m"


@pytest.mark.parametrize(("most", "run"), [(0, 0), (1, 0), (2, 2), (3, 2), (4, 4)])
def test_node_trials_are_kept_and_no_choice_runs_twice(
    tmp_path: Path, most: int, run: int
) -> None:
    judge = trials(tmp_path, 3)
    found = analyse(judge, ("backbone", "head"), node_trials=most)

    assert found.trials == 3 + run
    assert bool(found.findings[0].blamed) == (run == 4)
    analyse(judge, ("backbone", "head"), node_trials=most)
    assert judge.done == found.trials


def test_the_advice_floats_the_culprit_and_nothing_else(tmp_path: Path) -> None:
    judge = trials(tmp_path, 3)
    found = analyse(judge, ("backbone", "head"))
    limit = found.together.loss / 4

    choice = advise(judge, found, limit)

    assert choice == Int8Choice(("backbone", "head"), ("/head/MatMul_3",))
    assert judge.score(choice).loss <= limit
    assert advise(judge, found, 1e9) == Int8Choice(("backbone", "head"))
    assert advise(judge, found, 0.0) == Int8Choice(())


def invented(judge: Trials, cost: dict[str, float], *, joint: bool = False) -> Trials:
    """Losses by table: those of what is int8 added up; ``joint``: the largest."""

    def score(choice: Int8Choice) -> Score:
        costs = [
            cost[name]
            for module in choice.modules
            for name in int8_names(judge, module)
            if name not in choice.floats
        ]
        loss = max(costs, default=0.0) if joint else sum(costs)
        plan = Displacement(mean_m=loss, max_m=loss)
        return Score(Fidelity((), (), plan, "", 1, "plan"), 0)

    judge.score = score  # type: ignore[method-assign]
    return judge


COSTS = {"/backbone/MatMul_0": 0.1, "/backbone/MatMul_1": 0.1} | {
    f"/head/MatMul_{at}": loss for at, loss in enumerate((4, 0.2, 3, 0.1), start=2)
}


def test_what_costs_little_each_is_halved_no_further(tmp_path: Path) -> None:
    judge = invented(trials(tmp_path, 99), dict.fromkeys(COSTS, 1.0))
    asked = judge.score
    seen = list[int]()

    def counted(choice: Int8Choice) -> Score:
        seen.append(len(choice.floats))
        return asked(choice)

    judge.score = counted  # type: ignore[method-assign]
    found = analyse(judge, ("head",))

    assert not found.findings[0].blamed
    assert seen == [0, 2, 2, 3, 3, 3, 3, 0]


def test_one_culprit_after_the_other_is_given_up(tmp_path: Path) -> None:
    judge = invented(trials(tmp_path, 99), COSTS)
    found = analyse(judge, ("backbone", "head"))
    both = ("backbone", "head")

    assert advise(judge, found, 7.0) == Int8Choice(both, ("/head/MatMul_2",))


def test_what_fits_in_spite_of_its_blame_is_taken_back(tmp_path: Path) -> None:
    judge = invented(trials(tmp_path, 99), COSTS, joint=True)
    found = analyse(judge, ("backbone", "head"))
    blamed = [node for node, _ in found.findings[0].blamed]
    assert blamed == ["/head/MatMul_2", "/head/MatMul_4"]

    # 4 was in vain, 2 alone is too much
    choice = advise(judge, dataclasses.replace(found, findings=found.findings[::-1]), 3)

    assert choice == Int8Choice(("backbone", "head"), ("/head/MatMul_2",))


def test_the_recipe_makes_the_graph_that_was_judged(tmp_path: Path) -> None:
    judge = trials(tmp_path, 3)
    choice = Int8Choice(("backbone", "head"), ("/head/MatMul_3",))
    path = tmp_path / "elsewhere" / "advised.toml"
    path.parent.mkdir()
    overrides = write_recipe(path, choice, ["fold-constants"], "paper", "tensorrt")

    *_, int8 = recipe.load(path)
    made = int8.run(
        delicate(3), Context(MODULES, CalibrationSet(tmp_path / "frames"))
    ).model

    assert overrides == path.with_name("advised.overrides.toml")
    assert str(tmp_path) not in path.read_text()
    assert isinstance(int8, QuantizeInt8)
    made.metadata_props.clear()
    expected = judge.variant(choice)
    expected.metadata_props.clear()
    assert [node.name for node in made.graph] == [node.name for node in expected.graph]


def test_a_recipe_without_int8_has_no_int8(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"

    assert write_recipe(path, Int8Choice(()), ["fold-constants"], "paper", "x") is None
    assert [each.name for each in recipe.load(path)] == ["fold-constants"]


def test_a_model_without_a_plan_is_judged_by_its_worst_output(tmp_path: Path) -> None:
    judge = trials(tmp_path, 3)
    score = judge.score(Int8Choice(("head",)))
    bare = dataclasses.replace(
        score, fidelity=dataclasses.replace(score.fidelity, plan=None)
    )

    sqnr_db = score.fidelity.outputs[0].sqnr_db
    assert bare.loss == pytest.approx(10 ** (-sqnr_db / 20))
    assert bare.unit == "of the signal"


def test_the_worst_output_is_of_agents_that_match_and_no_whole_number(
    tmp_path: Path,
) -> None:
    def seen(order: str, noise: str) -> ir.Model:
        return parsed(f"""
            seen (float[1,4] x) => (float[1,4,3] boxes, float[1,4] s, int32[1,4] kind,
                float[1,4] pose) <int64[4] order = {{{order}}}, float[1] noise =
                {{{noise}}}, int64[1] two = {{2}}, float[3] far = {{10, 20, 1}}> {{
            s = Gather<axis=1>(x, order)
            u = Unsqueeze(s, two) boxes = Mul(u, far) kind = Cast<to=6>(s)
            pose = Add(x, noise)
        }}""")  # fmt: skip

    judge, other = trials(tmp_path, 3), seen("3, 1, 0, 2", "0.01")
    model = seen("0, 1, 2, 3", "0")
    model.metadata_props["me2e.sets"] = '{"boxes": "boxes", "scores": "s"}'
    frames = (Frame(0, True, {"x": np.array([[1, 2, 3, 4]], np.float32)}),)
    judge.reference = Reference.of(Session(model), frames)
    judge.variant = lambda choice: other  # type: ignore[method-assign]

    score = judge.score(Int8Choice(("head",)))

    _, _, kind, pose = score.fidelity.outputs
    assert kind.sqnr_db < pose.sqnr_db
    assert score.worst == pose
    assert score.loss == pytest.approx(10 ** (-pose.sqnr_db / 20))


# The search: int8 modules within budgets, and what is said when nothing fits.


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
    said = budget_message([size], [6_142_060.0], [[4_778_000.0]])

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
