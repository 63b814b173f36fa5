"""``score`` of real runs: what Bench2Drive's files say, and what follows from them."""

from pathlib import Path

import pytest

from tests.cli.test_drive import scored
from tests.evaluators.bench2drive.files import (
    RAMMED,
    checkpoint,
    merged,
    record,
    recording,
    speed,
    write,
)
from tests.support.command import Cli

GOOD = record(1711, min_speed_infractions=[speed(50.0), speed(1500.0)])
FAILED = record(
    2050,
    "EnterActorFlow",
    "Failed - TickRuntime",
    (80, 0.6, 48.0),
    collisions_vehicle=[RAMMED],
)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of a real run, in a wide terminal."""
    monkeypatch.setattr("me2e_compress.cli.console.console.width", 300)
    folder = tmp_path / "run"
    write(folder / "eval.json", checkpoint(GOOD, FAILED))
    write(folder / GOOD["save_name"] / "metric_info.json", recording(372))
    return folder


@pytest.mark.usefixtures("run")
def test_a_real_run_is_scored(cli: Cli) -> None:
    found = scored(cli, "score run")

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
    shown = cli.done("score run")
    assert "real runs, Bench2Drive's routes 0.0.3" in shown.out
    assert "driven │ 74.0000 │ 74.0000 │ 2 │ %" in shown.words
    assert "nowhere: no such folder" in cli.refused("score run --metrics nowhere")


@pytest.mark.usefixtures("run")
def test_a_routes_file_names_a_set_of_ones_own(cli: Cli, tmp_path: Path) -> None:
    ids = "".join(f'<route town="T" id="{each}"/>' for each in (1711, 2050, 9))
    (tmp_path / "own.xml").write_text(f"<routes>{ids}</routes>")
    (tmp_path / "empty.xml").write_text("<!-- <route id='1'/> --><routes/>")
    (tmp_path / "cut.xml").write_text("<routes><route id='1'")

    found = scored(cli, "score run own.xml")

    given = found["leaderboard"]["given"]["driving_score"]
    assert given == {"set": 148 / 3, "driven": 74.0}
    assert found["records"]["missing"] == ["9"]
    assert "empty.xml: no <route id=...>" in cli.refused("score run empty.xml")
    assert "cut.xml: not a routes file: unclosed" in cli.refused("score run cut.xml")
    assert "own.xml: one routes file" in cli.refused("score run empty.xml own.xml")
    assert "own.xml: it names the set" in cli.refused("score own.xml")


def test_what_is_wrong_with_a_real_run_is_said(cli: Cli, run: Path) -> None:
    odd = run.parent / "odd"
    write(odd / "m.json", merged(GOOD))
    write(odd / "w.json", checkpoint(record(score=(50, 1.0, 50)), record(469)))
    slow = recording(40, 0.5, yaw_degps=0.0, speed_mps=0.0, every=10)
    write(odd / GOOD["save_name"] / "metric_info.json", slow)
    (odd / "half.json").write_text('{"_checkpoint": {"records": [{"route_id"')

    shown = cli.done("score odd").words

    assert "foreign │ RouteScenario_469_rep0 │ 1" in shown
    assert "contradictory │ RouteScenario_1711_rep0 │ 1" in shown
    assert "not at 20 Hz │ RouteScenario_1711_rep0 │ 1" in shown
    assert "odd: 2 of 2 routes do not count as they should" in shown
    assert "odd: 1 files or records are broken and left out" in shown
