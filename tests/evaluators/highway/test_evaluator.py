import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.driving.contract import Evaluator
from me2e_compress.driving.latency import FixedLatency, MeasuredLatency, TraceLatency
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
from me2e_compress.evaluators.highway.results import ResultsFolder, fingerprint
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.metrics.episode import Ending, Episode
from me2e_compress.registry.marks import is_marked
from me2e_compress.simulator.routes import Route, save_routes
from tests.evaluators.highway.drivers import (
    CROSSING,
    EXIT,
    GREEN,
    PARKED,
    ROUTES,
    MisbehavingDriver,
)

TWO = (CROSSING, PARKED)
BLIND = Job(BlindDriver(), Conditions(TraceLatency((30_000, 170_000, 320_000))))
FASTER = Job(BlindDriver(9.0), BLIND.conditions)


def evaluator(
    folder: Path, job: Job = BLIND, routes: tuple[Route, ...] = ROUTES, workers: int = 1
) -> HighwayEvaluator:
    return HighwayEvaluator(job, routes, folder, 220, LocalEngine(workers))


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


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_the_bytes_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    judged: list[Evaluator] = [
        evaluator(tmp_path / str(workers), workers=workers) for workers in (1, 2)
    ]
    one, two = (tuple(each.episodes()) for each in judged)

    assert one == two
    assert [episode.route for episode in one] == [route.id for route in ROUTES]
    assert content(tmp_path / "1") == content(tmp_path / "2")
    assert len(content(tmp_path / "1")) == len(ROUTES) + 1


def test_wall_clock_times_lie_beside_the_folder(tmp_path: Path) -> None:
    list(evaluator(tmp_path / "results", routes=(PARKED,)).episodes())

    assert is_marked(tmp_path / "results.log")
    [line] = (tmp_path / "results.log").read_text().splitlines()

    cost = json.loads(line)
    assert cost["route"] == "parked"
    assert cost["seconds"] > 0.0
    assert cost["memory_mb"] > 50.0
    assert b"seconds" not in content(tmp_path / "results")["routes/parked.json"]


def test_finished_routes_are_not_driven_again(results: Path) -> None:
    reports = list[DrivingProgress]()
    before = content(results)
    ages = {path: path.stat().st_mtime_ns for path in results.rglob("*.json")}
    again = HighwayEvaluator(BLIND, TWO, results, 220, on_progress=reports.append)

    episodes = tuple(again.episodes())

    assert [episode.route for episode in episodes] == ["crossing", "parked"]
    assert content(results) == before
    assert {path: path.stat().st_mtime_ns for path in ages} == ages
    assert [(report.done, report.total) for report in reports] == [(2, 2)]


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")

    with pytest.raises(EvaluationError, match=r"/thesis: not empty, and holds no eval"):
        ResultsFolder.create(folder, _made_by(evaluator(folder)))
    assert list(content(folder)) == ["thesis.tex"]


@pytest.mark.parametrize("left", ["routes", ".evaluation.json.x1"])
def test_what_a_kill_left_at_the_beginning_does_not_matter(
    tmp_path: Path, left: str
) -> None:
    (tmp_path / "results" / left).mkdir(parents=True)
    folder = ResultsFolder.create(tmp_path / "results", _made_by(evaluator(tmp_path)))

    assert folder.episodes() == {}


def test_a_folder_from_before_latency_models_dropped_decisions(
    results: Path,
) -> None:
    manifest = results / "evaluation.json"
    made_by = json.loads(manifest.read_text())
    assert made_by.pop("latency_model") == "drop"
    manifest.write_text(json.dumps(made_by))

    made_now = _made_by(evaluator(results, routes=TWO))
    fifo = replace(BLIND.conditions, latency_model=LatencyModel.FIFO)
    delayed = _made_by(evaluator(results, Job(BlindDriver(), fifo), TWO))

    assert ResultsFolder.create(results, made_now).made_by == made_by
    with pytest.raises(EvaluationError, match=r'latency_model is "drop", .* "fifo"'):
        ResultsFolder.create(results, delayed)


def test_a_corrupt_file_is_named_and_driven_again(results: Path) -> None:
    warnings = list[str]()
    before = content(results)
    spoiled = results / "routes" / "parked.json"
    spoiled.write_bytes(before["routes/parked.json"][:1000])
    again = HighwayEvaluator(BLIND, TWO, results, 220, on_warning=warnings.append)

    list(again.episodes())

    assert content(results) == before
    assert [str(spoiled) in line for line in warnings] == [True]


def test_a_file_of_another_evaluation_is_driven_again(
    results: Path, driven_once: tuple[Path, Path]
) -> None:
    before = content(results)
    shutil.copy(driven_once[1] / "routes" / "parked.json", results / "routes")

    list(evaluator(results, routes=TWO).episodes())

    assert content(results) == before


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
    before = content(results)

    with pytest.raises(EvaluationError, match=f"another evaluation: its {key}"):
        list(evaluator(results, job, routes).episodes())
    assert content(results) == before


def test_a_killed_run_goes_on_with_nothing_lost_or_repeated(tmp_path: Path) -> None:
    manifest, folder = tmp_path / "routes.json", tmp_path / "results"
    routes = tuple(Route(f"exit_{k}", "HighwayExit", "Merging", k) for k in range(4))
    save_routes(routes, manifest)
    program = (
        "import sys; from pathlib import Path;"
        "from me2e_compress.simulator.routes import load_routes;"
        "from me2e_compress.evaluators.highway.evaluator import HighwayEvaluator;"
        "from me2e_compress.evaluators.highway.engine import LocalEngine;"
        "from me2e_compress.evaluators.highway.drivers import BlindDriver;"
        "from me2e_compress.evaluators.highway.conditions import Conditions;"
        "from me2e_compress.evaluators.highway.worker import Job;"
        "routes = load_routes(Path(sys.argv[1]));"
        "job = Job(BlindDriver(5.0), Conditions());"
        "list(HighwayEvaluator(job, routes, Path(sys.argv[2]), 4).episodes())"
    )
    command = [sys.executable, "-c", program, str(manifest), str(folder)]
    with subprocess.Popen(command, start_new_session=True) as running:
        written = folder / "routes"
        while len(list(written.glob("*.json")) if written.exists() else ()) < 1:
            assert running.poll() is None, "it ended before it could be killed"
            time.sleep(0.02)
        os.killpg(running.pid, signal.SIGKILL)
    finished = {path.name: path.read_bytes() for path in written.glob("*.json")}
    assert 1 <= len(finished) < len(routes)

    job = Job(BlindDriver(5.0), Conditions())
    going_on = HighwayEvaluator(job, routes, folder, 4)
    episodes = tuple(going_on.episodes())
    log = (tmp_path / "results.log").read_text().splitlines()
    driven = [json.loads(line)["route"] for line in log]

    assert [episode.route for episode in episodes] == [route.id for route in routes]
    assert sorted(driven) == sorted(route.id for route in routes)
    now = content(folder)
    assert all(now[f"routes/{name}"] == data for name, data in finished.items())
    undisturbed = tmp_path / "undisturbed"
    list(HighwayEvaluator(job, routes, undisturbed, 4).episodes())
    assert content(undisturbed) == now


def test_a_full_disk_is_one_line_and_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "results"
    full = evaluator(folder, routes=(CROSSING, PARKED))
    ResultsFolder.create(folder, _made_by(full))

    def no_space(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("me2e_compress.runtime.atomic.os.fsync", no_space)
        with pytest.raises(EvaluationError, match="the disk is full") as caught:
            list(full.episodes())
    assert "\n" not in str(caught.value)
    assert list(content(folder)) == ["evaluation.json"]

    assert len(list(full.episodes())) == 2


def _made_by(one: HighwayEvaluator) -> dict[str, object]:
    return fingerprint(one.job, one.routes, one.set_size)


def failed(folder: Path, way: str, limit_s: float = 60.0) -> tuple[Episode, ...]:
    job = Job(MisbehavingDriver(way), Conditions(), limit_s)
    return tuple(evaluator(folder, job, (EXIT, PARKED)).episodes())


def test_a_policy_that_hangs_fails_and_the_run_goes_on(tmp_path: Path) -> None:
    episodes = failed(tmp_path / "results", "hang", limit_s=0.5)

    assert [episode.ending for episode in episodes] == [Ending.POLICY_FAILED] * 2
    assert {episode.failure for episode in episodes} == {"no plan within 0.5 s"}
    # Nineteen frames at up to 8 m/s of a route of more than 100 m.
    assert all(0.0 < episode.completion_percent < 10.0 for episode in episodes)


def test_a_policy_that_takes_its_process_down_fails(tmp_path: Path) -> None:
    episodes = failed(tmp_path / "results", "die")

    assert {episode.failure for episode in episodes} == {
        "the policy ended its process with code 7"
    }


def test_a_process_that_was_killed_is_not_the_policys_fault(tmp_path: Path) -> None:
    words = r"route \w+: its process was killed \(out of memory\?\)"

    with pytest.raises(EvaluationError, match=words):
        failed(tmp_path / "results", "killed")
    assert list(content(tmp_path / "results")) == ["evaluation.json"]


def test_a_failed_route_is_a_result_like_any_other(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    episodes = failed(folder, "raise")

    assert failed(folder, "raise") == episodes
    assert len((tmp_path / "results.log").read_text().splitlines()) == 2


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
