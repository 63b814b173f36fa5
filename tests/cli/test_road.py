"""``sensitivity --drive``: int8 judged by how it drives."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.evaluators.highway.evaluator import HighwayEvaluator
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import save_routes
from tests.cli.conftest import Command, strict, write_frames
from tests.evaluators.highway.drivers import PARKED, straight_on
from tests.metrics.drives import drive as by_hand

BODY = """
    ["/planner/Cast"] order = Cast <to = 1> (command)
    ["/planner/Mul"] still = Mul (order, nothing)
    ["/planner/Add"] route = Add (ahead, still)
    ["/planner/MatMul"] plan = MatMul (route, turn)"""
MAP = """
    [modules.planner]
    role = "prediction"
    patterns = ["planner"]
    """


@pytest.fixture
def words(tmp_path: Path) -> tuple[str | Path, ...]:
    """The command over a model of one layer, which drives one short route blindly."""
    weights = ", float[2, 2] turn = {1, 0, 0, 1}, float[1] nothing = {0}"
    model = straight_on(tmp_path / "driver.onnx", body=BODY, initializers=weights)
    (tmp_path / "map.toml").write_text(MAP)
    write_frames(tmp_path / "frames", command=np.zeros(1, np.int64))
    save_routes((PARKED,), tmp_path / "routes.json")
    return (
        *("sensitivity", model, tmp_path / "frames", "--map", tmp_path / "map.toml"),
        *("-o", tmp_path / "r.toml", "--node-trials", "0", "--limit", "1000"),
        *("--rules", "paper"),  # the others keep so small a product in float
    )


def test_float_and_int8_drive_and_a_second_run_drives_nothing(
    command: Command,
    words: tuple[str | Path, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = (*words, "--drive", tmp_path / "routes.json")

    assert command(*words, "--json") == 0
    found = strict(capsys.readouterr().out)
    episodes = sorted((tmp_path / "r.drives").glob("*/routes/parked.json"))
    written = [path.stat().st_mtime_ns for path in episodes]

    names = [path.parents[1].name.rpartition("-")[0] for path in episodes]
    assert names == ["float", "planner"]
    assert 0 < found["float_driving"] < 100
    (planner,) = found["findings"]
    assert planner["driving"] == pytest.approx(found["float_driving"], abs=5)
    assert found["driving"] == planner["driving"]
    assert command(*words) == 0
    assert f"float {found['float_driving']:.1f}" in capsys.readouterr().out
    assert [path.stat().st_mtime_ns for path in episodes] == written


@pytest.mark.parametrize(("limit", "int8"), [("9.9", False), ("10", True)])
def test_the_recipe_keeps_a_limit_of_driving(
    command: Command,
    words: tuple[str | Path, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    limit: str,
    int8: bool,
) -> None:
    def episodes(self: HighwayEvaluator) -> Iterator[Episode]:
        percent = 10.0 if "planner" in self.folder.name else 20.0
        yield by_hand(completion=percent)

    monkeypatch.setattr(HighwayEvaluator, "episodes", episodes)

    how = ("--drive", tmp_path / "routes.json", "--drive-limit", limit)
    assert command(*words, *how) == 0
    assert ("quantize-int8" in (tmp_path / "r.toml").read_text()) == int8


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--drive-limit", "1"), "add --drive"),
        (("--drive", "nowhere"), "no route 'nowhere'"),
    ],
)
def test_words_about_driving_that_mean_nothing_are_one_line(
    command: Command,
    words: tuple[str | Path, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    more: tuple[str, ...],
    message: str,
) -> None:
    assert command(*words, *more) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert message in error
    assert not (tmp_path / "r.toml").exists()


def test_a_model_that_cannot_drive_is_refused_before_it_is_calibrated(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = command(
        *("sensitivity", dense / "dense.onnx", dense / "frames", "--drive", "1"),
        *("--map", dense / "map.toml", "-o", dense / "r.toml"),
    )

    assert done == 1
    assert "camera" in capsys.readouterr().err
