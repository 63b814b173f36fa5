"""EER_AV of folders: whose joules, whose weights, and what cannot be compared."""

import dataclasses
import re
from pathlib import Path

import pytest

from me2e_compress.base.errors import EnergyError, EvaluationError, RecipeError
from me2e_compress.cli.app import app
from me2e_compress.commands.options import Joules
from me2e_compress.commands.score import ScoreResult, score_eer
from me2e_compress.evaluators.results import ResultsFolder
from me2e_compress.metrics.episode import (
    Episode,
    Given,
    InferenceRecord,
    InfractionKind,
)
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.simulator.routes import ROAD_VERSION, VERSION
from tests.metrics.drives import cruise, drive, infraction
from tests.support.command import Cli

CRASH = infraction(InfractionKind.COLLISION_VEHICLE)


def driven(
    route: str, decisions: int, speed: float, *, crashed: bool = False
) -> Episode:
    found = drive(
        *[CRASH] * crashed,
        route=route,
        driven=cruise(speed=speed, traffic=10.0),
        completion=60.0 if crashed else 100.0,
    )
    records = tuple(InferenceRecord(0, 0) for _ in range(decisions))
    return dataclasses.replace(found, decisions=records)


FOLDERS = {
    "runs/fast": [driven("a", 9, 12.0), driven("b", 5, 15.0, crashed=True)],
    "runs/slow": [driven("b", 20, 5.0), driven("a", 14, 8.0)],
}


def test_every_folder_has_a_score_by_its_own_joules() -> None:
    found = score_eer(FOLDERS, {"fast": 2.0, "runs/slow": 3.0})

    assert found is not None
    scale = found.scale
    assert scale is not None
    # 9 and 5 decisions of 2 J, 20 and 14 of 3 J
    assert (scale.offset[3], scale.offset[3] + scale.span[3]) == (10.0, 60.0)
    first, last = found.ranking
    lines = ScoreResult({}, eer=found).lines()
    assert lines == (f"EER_AV, best first: {first}, {last}",)


def test_joules_come_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "energy.json"
    EnergyResult(6.0, 3, 2.0, low=1.5, high=2.5).save(file)

    found = score_eer(FOLDERS, {"fast": file, "slow": 3.0})
    given = score_eer(FOLDERS, {"fast": 2.0, "slow": 3.0})

    assert found is not None
    assert given is not None
    assert found is not None
    assert given is not None
    assert found.scores == given.scores
    assert score_eer(FOLDERS, {}) is None
    file.write_text("{}")
    with pytest.raises(EnergyError, match=r"energy\.json: not an energy file"):
        score_eer(FOLDERS, {"fast": file})


def test_what_one_real_run_lacks_is_left_out_of_all() -> None:
    given = Given("Completed", 100.0, 1.0, 100.0)
    real = {
        name: [dataclasses.replace(each, given=given) for each in episodes]
        for name, episodes in FOLDERS.items()
    }
    real["runs/slow"].append(dataclasses.replace(real["runs/slow"][0], route="c"))

    found = score_eer(real, {"fast": 2.0, "slow": 3.0})

    assert found is not None
    assert found.left_out == {"a drive in each": 1}
    assert found.scores["runs/slow"].n == 2


@pytest.mark.parametrize(
    ("joules", "said"),
    [
        ({"other": 2.0}, "energy of other: 0 folders of that name"),
        ({"fast": -1.0}, "energy of fast: -1.0 is not a number of joules"),
        ({"fast": float("nan")}, "nan is not a number of joules"),
    ],
)
def test_what_cannot_be_used_is_named(joules: Joules, said: str) -> None:
    with pytest.raises(EvaluationError, match=re.escape(said)):
        score_eer(FOLDERS, joules)


def test_other_routes_cannot_be_compared() -> None:
    mixed = {**FOLDERS, "runs/short": FOLDERS["runs/fast"][:1]}

    with pytest.raises(EvaluationError, match="runs/short: route b is in one of"):
        score_eer(mixed, {"fast": 2.0})


def test_joules_by_name() -> None:
    words = ["score", "runs", "--joules", "a=1.5", "--joules", "runs/b=e=2.json"]
    _, bound, _ = app.parse_args(words)
    found = bound.arguments["joules"]

    assert found == {"a": 1.5, "runs/b=e": "2.json"}


@pytest.mark.parametrize("words", [["1.5"], ["a="], ["=2"], ["a=1", "a=2"]])
def test_joules_without_a_name_or_with_two(words: list[str]) -> None:
    given = [each for word in words for each in ("--joules", word)]
    with pytest.raises(RecipeError, match="--joules"):
        app.parse_args(["score", "runs", *given])


def test_the_command_prints_what_the_page_says(tmp_path: Path, cli: Cli) -> None:
    for name, episodes in FOLDERS.items():
        path = tmp_path / Path(name).name
        made_by = {"routes": ["a", "b"], "set_size": 2, VERSION: ROAD_VERSION}
        folder = ResultsFolder.create(path, made_by)
        for each in episodes:
            folder.keep(each)
    document = cli.document("score fast slow --joules fast=2 --joules slow=3")

    scores = document["eer"]["scores"]
    assert {Path(name).name for name in scores} == {"fast", "slow"}
