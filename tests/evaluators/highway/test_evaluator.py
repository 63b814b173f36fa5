import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import Listener
from me2e_compress.driving.latency import FixedLatency, MeasuredLatency
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.highway.evaluator import longest_first
from me2e_compress.evaluators.results import ResultsFolder
from models.driver.expert.blind import BlindDriver
from tests.evaluators.highway.drivers import CROSSING, EXIT, PARKED, ROUTES
from tests.evaluators.highway.evaluations import TRACED, driven, made_by
from tests.support.command import contents
from tests.support.in_process import Here

TWO = (CROSSING, PARKED)
FASTER = BlindDriver(9.0)


@pytest.fixture(scope="module")
def driven_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two routes at 8 and at 9 m/s; take copies."""
    made = tmp_path_factory.mktemp("driven")
    driven(made / "8", TWO, engine=Here())
    driven(made / "9", TWO, FASTER, engine=Here())
    return made / "8", made / "9"


@pytest.fixture
def results(driven_once: tuple[Path, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(driven_once[0], tmp_path / "results"))


def test_the_bytes_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    routes = (PARKED, EXIT)  # the second takes longer, and begins first
    one = driven(tmp_path / "1", routes, engine=LocalEngine(1))
    two = driven(tmp_path / "2", routes, engine=LocalEngine(2))

    assert one == two
    assert [episode.route for episode in one] == ["parked", "exit"]
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert len(contents(tmp_path / "1")) == len(routes) + 1


def test_finished_routes_are_not_driven_again(results: Path) -> None:
    reports = list[tuple[str, int, int, str]]()
    before = contents(results)
    ages = {path: path.stat().st_mtime_ns for path in results.rglob("*.json")}
    listener = Listener(lambda *report: reports.append(report))

    episodes = driven(results, TWO, listener=listener)

    assert [episode.route for episode in episodes] == ["crossing", "parked"]
    assert contents(results) == before
    assert {path: path.stat().st_mtime_ns for path in ages} == ages
    assert [report[:3] for report in reports] == [("evaluate", 2, 2)]


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")

    with pytest.raises(EvaluationError, match=r"/thesis: not empty, and holds no eval"):
        ResultsFolder.create(folder, made_by())
    assert list(contents(folder)) == ["thesis.tex"]


@pytest.mark.parametrize("left", ["routes", ".evaluation.json.x1"])
def test_what_a_kill_left_at_the_beginning_does_not_matter(
    tmp_path: Path, left: str
) -> None:
    (tmp_path / "results" / left).mkdir(parents=True)
    folder = ResultsFolder.create(tmp_path / "results", made_by())

    assert folder.episodes() == {}


@pytest.mark.usefixtures("here")
def test_a_file_that_is_corrupt_or_of_another_evaluation_is_driven_again(
    results: Path, driven_once: tuple[Path, Path]
) -> None:
    warnings = list[str]()
    before = contents(results)
    spoiled = results / "routes" / "parked.json"
    spoiled.write_bytes(before["routes/parked.json"][:1000])

    driven(results, TWO, listener=Listener(on_warning=warnings.append))

    assert contents(results) == before
    assert [str(spoiled) in line for line in warnings] == [True]
    shutil.copy(driven_once[1] / "routes" / "parked.json", results / "routes")
    driven(results, TWO)
    assert contents(results) == before


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"policy": FASTER}, "policy"),
        ({"drive": replace(TRACED, latency=FixedLatency(1))}, "latency"),
        ({"drive": replace(TRACED, frame_limit_s=5.0)}, "frame_limit_s"),
        ({"routes": (PARKED, EXIT)}, "routes"),
        ({"routes": (replace(CROSSING, scenario="HighwayExit"), PARKED)}, "routes_sha"),
    ],
)
def test_results_of_another_evaluation_are_not_mixed(
    results: Path, changed: dict[str, Any], key: str
) -> None:
    before = contents(results)

    with pytest.raises(EvaluationError, match=f"another evaluation: its {key}"):
        driven(results, **dict[str, Any](routes=TWO) | changed)
    assert contents(results) == before


@pytest.mark.usefixtures("here")
def test_measured_latency_drives_alone_and_warns(tmp_path: Path) -> None:
    warnings = list[str]()

    episodes = driven(
        tmp_path / "results",
        (PARKED, EXIT),
        drive=Drive(MeasuredLatency(1000.0)),
        engine=LocalEngine(2),
        listener=Listener(on_warning=warnings.append),
    )

    assert len(warnings) == 1
    assert "one at a time" in warnings[0]
    charged = {d.latency_us for episode in episodes for d in episode.decisions}
    assert len(charged) > 1
    assert min(charged) > 1_000


def test_unknown_policies_are_refused_before_driving(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"policy missing.onnx: no such file"):
        driven(tmp_path / "r", policy=OnnxDriver(Path("missing.onnx")))
    assert not (tmp_path / "r").exists()


def test_long_types_begin_in_whatever_order_they_come() -> None:
    ordered = longest_first(ROUTES)

    assert [route.id for route in ordered] == ["green", "exit", "crossing", "parked"]
    assert longest_first(ROUTES[::-1]) == ordered
