import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.driving.contract import Evaluator
from me2e_compress.driving.latency import FixedLatency, MeasuredLatency
from me2e_compress.driving.realtime import LatencyModel
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.evaluators.highway.drivers import BlindDriver, OnnxDriver
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.highway.evaluator import (
    DrivingProgress,
    HighwayEvaluator,
    longest_first,
)
from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.registry.drafts import is_marked
from me2e_compress.simulator.routes import Route
from tests.command import contents
from tests.evaluators.highway.drivers import CROSSING, EXIT, GREEN, PARKED, ROUTES
from tests.evaluators.highway.evaluations import BLIND, evaluator, made_by

TWO = (CROSSING, PARKED)
FASTER = Job(BlindDriver(9.0), BLIND.conditions)


@pytest.fixture(scope="module")
def driven_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two routes at 8 and at 9 m/s; take copies."""
    made = tmp_path_factory.mktemp("driven")
    list(evaluator(made / "8", routes=TWO).episodes())
    list(evaluator(made / "9", FASTER, TWO).episodes())
    return made / "8", made / "9"


@pytest.fixture
def results(driven_once: tuple[Path, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(driven_once[0], tmp_path / "results"))


def test_the_bytes_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    judged: list[Evaluator] = [
        evaluator(tmp_path / str(workers), workers=workers) for workers in (1, 2)
    ]
    one, two = (tuple(each.episodes()) for each in judged)

    assert one == two
    assert [episode.route for episode in one] == [route.id for route in ROUTES]
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert len(contents(tmp_path / "1")) == len(ROUTES) + 1


def test_wall_clock_times_lie_beside_the_folder(tmp_path: Path) -> None:
    list(evaluator(tmp_path / "results", routes=(PARKED,)).episodes())

    assert is_marked(tmp_path / "results.log")
    [line] = (tmp_path / "results.log").read_text().splitlines()

    cost = json.loads(line)
    assert cost["route"] == "parked"
    assert cost["seconds"] > 0.0
    assert cost["memory_mb"] > 50.0
    assert b"seconds" not in contents(tmp_path / "results")["routes/parked.json"]


def test_finished_routes_are_not_driven_again(results: Path) -> None:
    reports = list[DrivingProgress]()
    before = contents(results)
    ages = {path: path.stat().st_mtime_ns for path in results.rglob("*.json")}
    again = HighwayEvaluator(BLIND, TWO, results, 220, on_progress=reports.append)

    episodes = tuple(again.episodes())

    assert [episode.route for episode in episodes] == ["crossing", "parked"]
    assert contents(results) == before
    assert {path: path.stat().st_mtime_ns for path in ages} == ages
    assert [(report.done, report.total) for report in reports] == [(2, 2)]


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")

    with pytest.raises(EvaluationError, match=r"/thesis: not empty, and holds no eval"):
        ResultsFolder.create(folder, made_by(evaluator(folder)))
    assert list(contents(folder)) == ["thesis.tex"]


@pytest.mark.parametrize("left", ["routes", ".evaluation.json.x1"])
def test_what_a_kill_left_at_the_beginning_does_not_matter(
    tmp_path: Path, left: str
) -> None:
    (tmp_path / "results" / left).mkdir(parents=True)
    folder = ResultsFolder.create(tmp_path / "results", made_by(evaluator(tmp_path)))

    assert folder.episodes() == {}


def test_a_folder_from_before_latency_models_dropped_decisions(
    results: Path,
) -> None:
    manifest = results / "evaluation.json"
    written = json.loads(manifest.read_text())
    assert written.pop("latency_model") == "drop"
    manifest.write_text(json.dumps(written))

    made_now = made_by(evaluator(results, routes=TWO))
    fifo = replace(BLIND.conditions, latency_model=LatencyModel.FIFO)
    delayed = made_by(evaluator(results, Job(BlindDriver(), fifo), TWO))

    assert ResultsFolder.create(results, made_now).made_by == written
    with pytest.raises(EvaluationError, match=r'latency_model is "drop", .* "fifo"'):
        ResultsFolder.create(results, delayed)


def test_a_corrupt_file_is_named_and_driven_again(results: Path) -> None:
    warnings = list[str]()
    before = contents(results)
    spoiled = results / "routes" / "parked.json"
    spoiled.write_bytes(before["routes/parked.json"][:1000])
    again = HighwayEvaluator(BLIND, TWO, results, 220, on_warning=warnings.append)

    list(again.episodes())

    assert contents(results) == before
    assert [str(spoiled) in line for line in warnings] == [True]


def test_a_file_of_another_evaluation_is_driven_again(
    results: Path, driven_once: tuple[Path, Path]
) -> None:
    before = contents(results)
    shutil.copy(driven_once[1] / "routes" / "parked.json", results / "routes")

    list(evaluator(results, routes=TWO).episodes())

    assert contents(results) == before


@pytest.mark.parametrize(
    ("job", "routes", "key"),
    [
        (FASTER, TWO, "policy"),
        (Job(BlindDriver(), Conditions(FixedLatency(1))), TWO, "latency"),
        (Job(BlindDriver(), BLIND.conditions, 5.0), TWO, "frame_limit_s"),
        (BLIND, (PARKED, EXIT), "routes"),
        (BLIND, (Route("crossing", "HighwayExit", "Merging", 1), PARKED), "routes_sh"),
    ],
)
def test_results_of_another_evaluation_are_not_mixed(
    results: Path, job: Job, routes: tuple[Route, ...], key: str
) -> None:
    before = contents(results)

    with pytest.raises(EvaluationError, match=f"another evaluation: its {key}"):
        list(evaluator(results, job, routes).episodes())
    assert contents(results) == before


def test_measured_latency_drives_alone_and_warns(tmp_path: Path) -> None:
    warnings = list[str]()
    job = Job(BlindDriver(), Conditions(MeasuredLatency(1000.0)))
    measured = HighwayEvaluator(
        job,
        (PARKED, EXIT),
        tmp_path / "results",
        220,
        LocalEngine(2),
        on_warning=warnings.append,
    )

    episodes = tuple(measured.episodes())

    assert len(warnings) == 1
    assert "one at a time" in warnings[0]
    charged = {d.latency_us for episode in episodes for d in episode.decisions}
    assert len(charged) > 1
    assert min(charged) > 1_000


def test_unknown_policies_are_refused_before_driving(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"policy missing.onnx: no such file"):
        list(
            evaluator(
                tmp_path / "r", Job(OnnxDriver(Path("missing.onnx")), Conditions())
            ).episodes()
        )
    assert not (tmp_path / "r").exists()


def test_long_types_begin_in_whatever_order_they_come() -> None:
    ordered = longest_first(ROUTES)

    assert [route.id for route in ordered] == ["green", "exit", "crossing", "parked"]
    assert longest_first(ROUTES[::-1]) == ordered


def test_progress_runs_with_the_scores(tmp_path: Path) -> None:
    reports = list[DrivingProgress]()
    one = HighwayEvaluator(
        BLIND, (PARKED, GREEN), tmp_path / "r", 220, on_progress=reports.append
    )
    list(one.episodes())

    assert reports[0] == DrivingProgress(0, 2, None, None)
    assert [report.done for report in reports] == [0, 1, 2]
    assert reports[-1].driving_score is not None
    assert 0.0 < reports[-1].driving_score < 100.0
