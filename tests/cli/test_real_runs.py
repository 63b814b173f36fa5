import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from me2e_compress.cli.app import app
from me2e_compress.errors import EvaluationError
from tests.docs.documents import faults
from tests.evaluators.bench2drive.files import (
    RAMMED,
    checkpoint,
    merged,
    record,
    recording,
    speed,
    write,
)

Run = Callable[..., str]

GOOD = record(1711, min_speed_infractions=[speed(50.0), speed(1500.0)])
FAILED = record(
    2050,
    "EnterActorFlow",
    "Failed - TickRuntime",
    (80, 0.6, 48.0),
    collisions_vehicle=[RAMMED],
)


@pytest.fixture
def run() -> Run:
    def invoke(*words: str | Path) -> str:
        result = CliRunner().invoke(
            app, ["score", *map(str, words)], env={"COLUMNS": "300"}
        )
        if result.exception is not None:
            raise result.exception
        return result.stdout

    return invoke


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    write(folder / "eval.json", checkpoint(GOOD, FAILED))
    write(folder / GOOD["save_name"] / "metric_info.json", recording(372))
    return folder


def scored(run: Run, *words: str | Path) -> Any:
    document = json.loads(run(*words, "--json"))
    assert faults("score", document) == []
    (folder,) = document["folders"]
    return folder


def test_a_real_run_is_scored(run: Run, results: Path) -> None:
    found = scored(run, results)

    given, computed = found["leaderboard"]["given"], found["leaderboard"]["computed"]
    assert given["driving_score"] == {"set": 148 / 220, "driven": 74.0}
    assert computed["driving_score"] == {"set": 148 / 220, "driven": 74.0}
    assert computed["success_rate"]["driven"] == 50.0
    assert found["records"]["evaluated"] == 2
    assert len(found["records"]["missing"]) == 218
    assert found["records"]["unrecorded"] == ["RouteScenario_2050_rep0"]
    assert found["bench2drive"]["efficiency"]["value"] == 50.0
    assert found["bench2drive"]["smoothness"]["value"] == 0.0
    assert found["comfort"]["value"] == 1.0
    assert found["abilities"]["each"]["Merging"]["value"] == 0.0
    assert found["abilities"]["each"]["Traffic_Signs"]["value"] is None


def test_options_decide_what_is_computed(run: Run, results: Path) -> None:
    junctions = write(results.parent / "j.json", {"2050": 0.5})

    found = scored(
        *(run, results, "--abilities", "0.0.4", "--penalties", "2.1"),
        *("--junctions", junctions),
    )

    assert found["abilities"]["each"]["Traffic_Signs"]["value"] == 100.0
    computed = found["leaderboard"]["computed"]
    # 50 % of the traffic's speed costs 0.2, the collision 0.7
    driven = computed["driving_score"]["driven"]
    assert driven == pytest.approx((100 / 1.2 + 80 / 1.7) / 2, abs=1e-6)
    without = computed["driving_score_without_low_speed"]["driven"]
    assert without == pytest.approx((100 + 80 / 1.7) / 2, abs=1e-6)


def test_both_columns_are_shown(run: Run, results: Path) -> None:
    shown = run(results)

    assert "real runs, Bench2Drive's routes 0.0.3" in shown
    rows = [" ".join(line.split()) for line in shown.splitlines()]
    assert any("driven │ 74.0000 │ 74.0000 │ 2 │ %" in row for row in rows)


def test_what_is_wrong_is_said(run: Run, tmp_path: Path) -> None:
    write(tmp_path / "m.json", merged(GOOD, said={"eval num": 5}))
    write(tmp_path / "w.json", checkpoint(record(score=(50, 1.0, 50)), record(469)))
    slow = recording(40, 0.5, yaw_degps=0.0, speed_mps=0.0, every=10)
    write(tmp_path / GOOD["save_name"] / "metric_info.json", slow)
    (tmp_path / "half.json").write_text('{"_checkpoint": {"records": [{"route_id"')

    shown = run(tmp_path)

    assert "of another set than 0.0.3: RouteScenario_469_rep0" in shown
    assert "the lowest driving score counts: RouteScenario_1711_rep0" in shown
    assert "half.json: not JSON" in shown
    assert "m.json: it says eval num 5, its records say 1" in shown
    assert "the ego stood most of the time" in shown
    assert "1 of 2, RouteScenario_1711_rep0 at 2 Hz" in shown


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--abilities", "0.0.5"),
            "no rules '0.0.5' of abilities; there are 0.0.3, 0.0.4",
        ),
        (("--penalties", "3"), "no penalties '3'; there are b2d, 1.0, 2.0, 2.1"),
        (("--metrics", "nowhere"), "nowhere: no such folder"),
        (("--junctions", "nowhere"), "nowhere: cannot be read: No such file"),
    ],
)
def test_wrong_words_are_one_line(
    run: Run, results: Path, words: tuple[str, ...], message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        run(results, *words)


@pytest.mark.parametrize(
    "places", [[], {"2050": "far"}, {"2050": float("nan")}, {"2050": 10**400}]
)
def test_a_bad_file_of_junctions(run: Run, results: Path, places: object) -> None:
    file = write(results.parent / "j.json", places)

    with pytest.raises(EvaluationError, match=r"j\.json: "):
        run(results, "--junctions", file)
