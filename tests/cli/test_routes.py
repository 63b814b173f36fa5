import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from me2e_compress.cli.app import app
from me2e_compress.errors import EvaluationError
from me2e_compress.simulator.routes import load_routes, save_routes
from tests.docs.documents import faults
from tests.simulator.world.driving import route_of

STOP = "VanillaNonSignalizedTurnEncounterStopsign"


def run(*words: str | Path) -> tuple[int, str, BaseException | None]:
    done = CliRunner().invoke(app, ["routes", *map(str, words)])
    return done.exit_code, done.stdout, done.exception


def test_a_fresh_set_is_made_admitted_and_reported(tmp_path: Path) -> None:
    file = tmp_path / "one.json"
    asked = ("--seed", "4", "--variants", "2", "--scenarios", STOP, "--json")

    code, out, _ = run("-o", file, *asked)

    report = json.loads(out)
    assert faults("routes", report) == []
    assert code == 0
    assert report["admitted"] == 2
    assert report["tried"] == 2 + len(report["scenarios"][0]["refusals"])
    assert [route.id for route in load_routes(file)] == [f"{STOP}_0", f"{STOP}_1"]


def test_a_set_is_put_through_the_gate_again(tmp_path: Path) -> None:
    file = tmp_path / "routes.json"
    save_routes([route_of(STOP, 1)], file)

    code, out, _ = run("--examine", file)

    assert code == 0
    assert "1 of 1 route admitted" in out


def test_a_route_that_is_too_easy_is_named(tmp_path: Path) -> None:
    file = tmp_path / "routes.json"
    easy = route_of("VehicleOpensDoorTwoWays", 1, door_m=1000.0)
    save_routes([easy], file)

    code, out, error = run("--examine", file, "--json")

    assert code != 0
    assert isinstance(error, EvaluationError)
    assert "test: the blind driver commits no infraction at 4 m/s" in str(error)
    found = json.loads(out)
    assert faults("routes", found) == []
    assert found["status"] == "refused"
    assert list(found["refused"]) == ["test"]


def test_an_unknown_type_is_named(tmp_path: Path) -> None:
    _, _, error = run("-o", tmp_path / "routes.json", "--scenarios", "Flying")

    with pytest.raises(EvaluationError, match="no scenario 'Flying'; there are"):
        raise error or AssertionError("nothing was raised")


def test_a_new_set_needs_a_place() -> None:
    code, _, _ = run("--seed", "1")

    assert code == 2
