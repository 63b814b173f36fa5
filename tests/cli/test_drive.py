"""``evaluate``, ``score``, ``profile`` and ``routes``: the closed loop."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pynvml
import pytest

from me2e_compress.base.atomic import IN_JSON
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.simulator.routes import save_routes
from tests.commands.test_check_model import ADAPTER, PLAN, tcp_like
from tests.evaluators.highway.drivers import CROSSING, PARKED, straight_on
from tests.runtime.energy.opened import Driver
from tests.simulator.world.driving import route_of
from tests.support.command import Cli
from tests.support.frames import record
from tests.support.nets import save_text

pytestmark = pytest.mark.usefixtures("here")

BLIND = "evaluate blind --routes routes.json -o results"
STOP = "VanillaNonSignalizedTurnEncounterStopsign"


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    """The folder with routes.json: a crossing, and a parked car."""
    save_routes((CROSSING, PARKED), tmp_path / "routes.json")
    return tmp_path


def scored(cli: Cli, line: str) -> Any:
    (folder,) = cli.document(line)["folders"]
    return folder


@pytest.mark.usefixtures("manifest")
def test_evaluate_and_score_say_the_same(cli: Cli) -> None:
    driven = cli.document(BLIND)
    found = scored(cli, "score results")

    assert {"results": "results", **driven}.items() >= found.items()
    assert found["success_rate"]["value"] == 0.0
    routes = {"driven": 2, "expected": 2, "partial": False, "failed": 0}
    assert found["routes"] == routes
    assert set(found["driving_score"]) >= {"value", "low", "high", "n"}


def test_a_drive_tells_no_more_of_its_latencies_than_their_trace(
    cli: Cli, manifest: Path
) -> None:
    LatencyTrace("0", "a CPU", (10_000,) * 16).save(manifest / "trace.json")

    driven = cli.document(f"{BLIND} --latency trace:trace.json")["deadlines"]

    assert driven["decisions"] >= 100
    assert (driven["p50_ms"], driven["p99_ms"]) == (10.0, None)
    assert scored(cli, "score results")["deadlines"] == driven


def test_a_route_that_cannot_be_counted_is_left_out(cli: Cli, manifest: Path) -> None:
    """One beyond its end, one that stands there twice, and one that is missing."""
    cli.done(BLIND)
    routes = manifest / "results" / "routes"
    parked, crossing = routes / "parked.json", (routes / "crossing.json").read_bytes()
    far = json.loads(parked.read_text())
    far["episode"]["completion_percent"] = 5000.0
    for content in (json.dumps(far).encode(), crossing):
        parked.write_bytes(content)
        assert scored(cli, "score results")["routes"]["driven"] == 1
    parked.unlink()
    assert "1 of 2 routes, PARTIAL" in cli.done("score results").words


@pytest.mark.usefixtures("short")
def test_a_route_is_drawn(cli: Cli, manifest: Path) -> None:
    straight_on(manifest / "m.onnx")
    weather = "--render crossing --weather fog_m=60,dropped=BACK+FRONT_LEFT"
    cli.done(f"evaluate m.onnx --routes routes.json -o results {weather}")

    drawn = manifest / "results" / "crossing.gif"
    assert drawn.read_bytes().startswith(b"GIF89a")
    assert drawn.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_what_fits_and_what_is_missing_is_said_before_a_drive(
    cli: Cli, tmp_path: Path
) -> None:
    (tmp_path / "a.toml").write_text(ADAPTER + PLAN)
    tcp_like(tmp_path / "m.onnx")

    found = cli.document("evaluate m.onnx --check --adapter a.toml")
    assert found["status"] == "ok"
    assert "input" in cli.done("evaluate m.onnx --check --adapter a.toml").out
    found = cli.document("evaluate m.onnx --check", code=1)
    assert found["status"] == "refused"
    assert "could not drive: " in cli.refused("evaluate m.onnx --check --json")


def test_a_profile_is_a_latency_trace(cli: Cli, manifest: Path) -> None:
    save_text(manifest / "m.onnx", "d (float[3] x) => (float[3] y) { y = Add (x, x) }")
    record(manifest / "frames", [{"x": np.zeros(3, np.float32)}] * 4)

    line = "profile m.onnx frames -o trace.json --by-module"
    shown = cli.document(line)

    assert [each["name"] for each in shown["modules"]] == ["model", "(between nodes)"]
    saved = json.loads((manifest / "trace.json").read_text())
    assert saved == IN_JSON | {key: shown[key] for key in saved if key in shown}
    assert len(shown["samples_us"]) == 4
    assert shown["p50_us"] <= shown["max_us"]
    assert shown["p90_us"] is shown["p99_us"] is None  # of four samples
    cli.done(f"{BLIND} --latency trace{{trace=trace.json,in_order=true,scale=1000}}")


JOULES = (
    "profile dense.onnx frames -o trace.json --samples 2 --by-module"
    " --energy recorded:orin.csv"
)


def write_power(folder: Path, watts: float = 30.0) -> None:
    """Write six minutes at ten frames a second, ten seconds idle around them."""
    rows = ["time_s,frames,watts"]
    for second in range(381):
        frames = 10 * min(max(0, second - 10), 360)
        rows.append(f"{second},{frames},{watts if 10 < second <= 370 else 12.0}")
    (folder / "orin.csv").write_text("\n".join(rows))


def test_joules_are_shown_and_written(cli: Cli, dense: Path) -> None:
    write_power(dense)

    shown = cli.done(JOULES).words
    found = EnergyResult.load(dense / "trace.energy.json")
    assert found.j_per_frame == pytest.approx(3.0, rel=0.01)
    assert "energy: 3 J a frame (2.995 to 3.005)" in shown
    assert "recorded-power-integrated of orin.csv (as recorded)" in shown
    document = cli.document(JOULES)
    written = json.loads((dense / "trace.energy.json").read_text())
    assert written == IN_JSON | document["energy"]


def test_no_counter_is_no_figure_and_one_that_stands_still_is_an_error(
    cli: Cli, dense: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Driver(monkeypatch, init=-pynvml.NVML_ERROR_LIBRARY_NOT_FOUND)
    shown = cli.document(JOULES.replace("recorded:orin.csv", "nvml"))
    reason = "no energy counter answers (nvml: NVML Shared Library Not Found)"
    assert (shown["energy"]["joules"], shown["energy"]["reason"]) == (None, reason)
    assert f"energy: not measured: {reason}" in shown["verdict"]
    write_power(dense, watts=0.0)
    said = cli.refused(JOULES)
    assert "energy recording: the counter stands still" in said


def test_drives_of_another_road_are_refused(cli: Cli, tmp_path: Path) -> None:
    save_routes([route_of(STOP, 1)], tmp_path / "new.json")

    report = cli.document("evaluate blind:12 -o out --routes new.json")

    assert report["routes"]["driven"] == 1
    manifest = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    old = json.dumps(manifest | {"road_version": 0})
    (tmp_path / "out" / "evaluation.json").write_text(old)
    assert "out: is of version 0 of the generator" in cli.refused("score out")
    del manifest["road_version"]
    (tmp_path / "out" / "evaluation.json").write_text(json.dumps(manifest))
    assert "out: is of version None of the generator" in cli.refused("score out")
