"""``sensitivity`` and ``search``: recipes by what int8 costs, also on the road."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.evaluators.highway.evaluator import HighwayEvaluator
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import save_routes
from tests.command import Cli, write_frames
from tests.evaluators.highway.drivers import PARKED, straight_on
from tests.metrics.drives import drive as by_hand

F = "dense.onnx frames --map map.toml -o r.toml"


def test_sensitivity_writes_a_recipe_that_compresses(cli: Cli, dense: Path) -> None:
    shown = cli.done(f"sensitivity {F} --limit 1").out
    assert "planner" in shown
    assert "limit 1" in shown

    how = "-r r.toml --map map.toml --frames frames -o out.onnx"
    cli.done(f"compress dense.onnx {how}")
    ops = [node.op_type for node in graph.load(dense / "out.onnx").graph]
    assert "QuantizeLinear" in ops


@pytest.mark.parametrize(
    ("line", "int8"),
    [
        (f"sensitivity {F} --limit 0", False),
        (f"search {F} --max-mb 1", False),
        (f"search {F} --max-mb 0.001", True),
    ],
)
def test_the_recipe_has_the_least_int8_that_fits(
    cli: Cli, dense: Path, line: str, int8: bool
) -> None:
    cli.done(line)

    assert ("quantize-int8" in (dense / "r.toml").read_text()) == int8


def test_saved_ranges_are_taken_and_stale_ones_refused(cli: Cli, dense: Path) -> None:
    saved = dense / "ranges.json"
    cli.done("calibrate dense.onnx frames --map map.toml -o ranges.json")

    cli.done(f"sensitivity {F} --ranges ranges.json")
    stale = json.loads(saved.read_text()) | {"model": "other"}
    saved.write_text(json.dumps(stale))
    said = cli.refused(f"sensitivity {F} --ranges ranges.json")
    assert "stale: of graph other" in said


@pytest.mark.parametrize(
    ("line", "rows"),
    [(f"sensitivity {F}", "findings"), (f"search {F} --max-mb 1", "tried")],
)
def test_programs_get_json_and_the_recipe(
    cli: Cli, dense: Path, line: str, rows: str
) -> None:
    assert len(cli.document(line)[rows]) == 1
    assert (dense / "r.toml").is_file()


@pytest.mark.usefixtures("dense")
def test_search_keeps_size_time_and_energy_at_once(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    battery = SimpleNamespace(j_per_frame=0.5)
    budgets = "me2e_compress.workflows.budgets"
    monkeypatch.setattr(f"{budgets}.open_counter", lambda: None)
    monkeypatch.setattr(
        f"{budgets}.measure_energy", lambda models, *_, **__: {"model": battery}
    )

    found = cli.document(f"search {F} --max-ms 10000 --max-mb 1 --max-joules 1")

    units = [each["unit"] for each in found["budgets"]]
    assert units == ["bytes of weights", "s", "J"]
    assert len(found["tried"][-1]["measured_costs"]) == 3


BODY = """
    ["/planner/Cast"] order = Cast <to = 1> (command)
    ["/planner/Mul"] still = Mul (order, nothing)
    ["/planner/Add"] route = Add (ahead, still)
    ["/planner/MatMul"] plan = MatMul (route, turn)"""
ROAD = (
    "sensitivity driver.onnx frames --map map.toml -o r.toml --node-trials 0"
    " --limit 1000 --rules paper"  # the others keep so small a product in float
)


@pytest.fixture
def road(cli: Cli, tmp_path: Path) -> Cli:
    """A model of one layer, which drives one short route blindly."""
    weights = ", float[2, 2] turn = {1, 0, 0, 1}, float[1] nothing = {0}"
    straight_on(tmp_path / "driver.onnx", body=BODY, initializers=weights)
    (tmp_path / "map.toml").write_text(
        '[modules.planner]\nrole = "prediction"\npatterns = ["planner"]'
    )
    write_frames(tmp_path / "frames", command=np.zeros(1, np.int64))
    save_routes((PARKED,), tmp_path / "routes.json")
    return cli


def test_float_and_int8_drive_and_a_second_run_drives_nothing(
    road: Cli, tmp_path: Path
) -> None:
    found = road.document(f"{ROAD} --drive routes.json")
    episodes = sorted((tmp_path / "r.drives").glob("*/routes/parked.json"))
    written = [path.stat().st_mtime_ns for path in episodes]

    names = [path.parents[1].name.rpartition("-")[0] for path in episodes]
    assert names == ["float", "planner"]
    assert 0 < found["float_driving"] < 100
    (planner,) = found["findings"]
    assert planner["driving"] == pytest.approx(found["float_driving"], abs=5)
    assert found["driving"] == planner["driving"]
    said = road.done(f"{ROAD} --drive routes.json").out
    assert f"float {found['float_driving']:.1f}" in said
    assert [path.stat().st_mtime_ns for path in episodes] == written


@pytest.mark.parametrize(("limit", "int8"), [("9.9", False), ("10", True)])
def test_the_recipe_keeps_a_limit_of_driving(
    road: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, int8: bool
) -> None:
    def episodes(self: HighwayEvaluator) -> Iterator[Episode]:
        percent = 10.0 if "planner" in self.folder.name else 20.0
        yield by_hand(completion=percent)

    monkeypatch.setattr(HighwayEvaluator, "episodes", episodes)

    road.done(f"{ROAD} --drive routes.json --drive-limit {limit}")
    assert ("quantize-int8" in (tmp_path / "r.toml").read_text()) == int8


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("--drive-limit 1", "add --drive"),
        ("--drive nowhere", "no route 'nowhere'"),
    ],
)
def test_words_about_driving_that_mean_nothing_are_one_line(
    road: Cli, more: str, message: str
) -> None:
    assert message in road.refused(f"{ROAD} {more}")
