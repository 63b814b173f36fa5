"""Percentiles of what decisions were charged: of a trace, no more than it tells."""

from dataclasses import replace
from pathlib import Path

from me2e_compress.commands.score import score
from me2e_compress.evaluators.results import ResultsFolder
from me2e_compress.metrics.episode import ConflictRecord, InferenceRecord
from me2e_compress.simulator.routes import ROAD_VERSION, VERSION
from tests.metrics.drives import cruise, drive

MADE_BY = {"routes": ["r"], "set_size": 1, VERSION: ROAD_VERSION}


def kept(path: Path, measured: int | None) -> ResultsFolder:
    folder = ResultsFolder.create(path, MADE_BY, measured)
    decisions = tuple(InferenceRecord(50_000 * at, 40_000) for at in range(1000))
    folder.keep(replace(drive(driven=cruise()), route="r", decisions=decisions))
    return folder


def test_a_folder_keeps_how_many_samples_its_latencies_are_of(tmp_path: Path) -> None:
    for name, measured in {"trace": 16, "measured": None}.items():
        kept(tmp_path / name, measured)
    drawn, own = str(tmp_path / "trace"), str(tmp_path / "measured")

    late = score(drawn, own).late

    why = late[drawn].measures["p99_ms"].reason
    assert why == "needs 100 samples, has 16"
    assert late[own].measures["p99.9_ms"].value == 40.0


def test_that_number_makes_no_other_evaluation(tmp_path: Path) -> None:
    before = kept(tmp_path, None)

    assert ResultsFolder.create(tmp_path, MADE_BY, 16).episodes() == before.episodes()


def test_what_ds_does_not_see_stands_beside_it(tmp_path: Path) -> None:
    near = ConflictRecord((9.0, 3.5), (None, 1.0), ())
    folder = ResultsFolder.create(tmp_path, MADE_BY, None)
    folder.keep(replace(drive(driven=cruise(), conflicts=near), route="r"))

    found = score(tmp_path)

    told = "driving score 100.0 (- to -), room kept 50.0 (- to -) %; 1 of 1 routes"
    assert found.headline.endswith(told)
    rows = [row[0].text for row in found.tables()[0].rows]
    assert rows[3:5] == ["efficiency", "Bench2Drive's efficiency"]
