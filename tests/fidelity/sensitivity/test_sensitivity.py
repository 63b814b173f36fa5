import dataclasses
from pathlib import Path

import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.fidelity.compare import Displacement, Fidelity
from me2e_compress.fidelity.sensitivity import (
    Int8Choice,
    Score,
    Trials,
    advise,
    analyse,
    names_of,
    write_recipe,
)
from me2e_compress.manager import recipe
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from tests.fidelity.sensitivity.delicate import delicate, trials
from tests.nets import MODULES


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
            for name in names_of(judge, module)
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
