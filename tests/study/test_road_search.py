"""A search on the road whose drives are made up, of models that are made."""

import dataclasses
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.errors import EvaluationError, StudyError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.worker import Driven, Job
from me2e_compress.manager import recipe
from me2e_compress.metrics.episode import Ending, Episode
from me2e_compress.registry.marks import is_marked
from me2e_compress.simulator.routes import Route, load_routes, pick_routes
from me2e_compress.study.on_road import (
    Limits,
    RoadSearchOptions,
    RoadSearchResult,
    search_on_road,
)
from tests.command import write_frames
from tests.docs.documents import faults
from tests.evaluators.highway.drivers import straight_on

ROUTES = pick_routes(load_routes(), "8")
MAP = "\n".join(
    f'[modules.{name}]\nrole = "{role}"\npatterns = ["{name}"]'
    for name, role in (
        ("backbone", "feature"),
        ("occ", "prediction"),
        ("map", "prediction"),
        ("planner", "prediction"),
    )
)
WEIGHTS = ", ".join(["0.0"] * 64)
BODY = """
["/backbone/Cast"] cast = Cast <to = 1> (command)
["/occ/MatMul"] occ = MatMul (cast, occ_weight)
["/map/MatMul"] map = MatMul (cast, map_weight)
["/planner/Add"] both = Add (occ, map)
["/planner/ReduceSum"] zero = ReduceSum <keepdims = 0> (both)
["/planner/Add_1"] plan = Add (ahead, zero)
"""
QUALITY = {"float": 80.0, "exact": 80.0, "without-occ": 85.0, "without-map": 40.0}


@dataclass
class Scripted:
    """Knows how well each scheme drives, and writes down what it was asked."""

    driven: list[tuple[str, str]] = field(default_factory=list)
    most: int = 10_000

    def drive(self, job: Job, routes: Sequence[Route]) -> Iterator[Driven]:
        assert isinstance(job.driver, OnnxDriver)
        scheme = job.driver.path.name.split(".")[0]
        for route in routes:
            if len(self.driven) == self.most:
                raise EvaluationError("killed")
            self.driven.append((scheme, route.id))
            percent = QUALITY[scheme] + (route.seed % 3) * (scheme == "without-occ")
            yield Driven(_episode(route, percent), 1.0, 0)


def _episode(route: Route, percent: float) -> Episode:
    end = Ending.COMPLETED
    return Episode(
        route.id, route.scenario, route.abilities, 100.0, percent, end, None, (), (), ()
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A driver of four modules; beside it frames and its map."""
    folder = tmp_path_factory.mktemp("model")
    weights = f", float[1, 64] occ_weight = {{{WEIGHTS}}}"
    weights += weights.replace("occ", "map")
    straight_on(folder / "float.onnx", body=BODY, initializers=weights)
    write_frames(folder / "frames", command=np.array([3]))
    (folder / "map.toml").write_text(MAP)
    return folder / "float.onnx"


def asked(model: Path, drives: Path) -> RoadSearchOptions:
    return RoadSearchOptions(
        drives=drives,
        limits=Limits(max_mb=1.0, max_joules=1.0),
        modules="backbone",
        routes=",".join(each.id for each in ROUTES),
        latency="none",
        first_rung=2,
        module_map=str(model.parent / "map.toml"),
        samples=2,
    )


def search(
    model: Path, options: RoadSearchOptions, engine: Scripted, tell: list[str]
) -> RoadSearchResult:
    output = options.drives.with_suffix(".toml")
    frames = model.parent / "frames"
    return search_on_road(model, frames, output, options, engine, tell=tell.append)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory, model: Path) -> RoadSearchOptions:
    """A search that was killed after six routes."""
    options = asked(model, tmp_path_factory.mktemp("search") / "drives")
    with pytest.raises(EvaluationError, match="killed"):
        search(model, options, Scripted(most=6), [])
    return options


@pytest.fixture(scope="module")
def found(
    killed: RoadSearchOptions, model: Path
) -> tuple[RoadSearchResult, Scripted, list[str]]:
    """The same search, gone on with; what it drove and told."""
    engine, told = Scripted(), list[str]()
    done = search(model, killed, engine, told)
    assert is_marked(done.output)
    return done, engine, told


Found = tuple[RoadSearchResult, Scripted, list[str]]


def test_the_best_on_the_road_is_the_recipe(found: Found) -> None:
    result, _, _ = found

    (ablate,) = (each for each in recipe.load(result.output) if not each.exact)
    assert ablate.name == "ablate-modules"
    assert result.winner == "without-occ"
    assert result.difference.better == len(ROUTES)
    assert result.worse_by_at_most == pytest.approx(27.1, abs=0.05)
    assert re.match(
        r"this one: without-occ \(\+6\.0 DS\); on 8 routes it is not worse than"
        r" float by more than 27\.1 DS \(95 %, two-sided: -27\.1 to \+35\.4, over",
        result.headline,
    )


def test_the_budgets_are_met_with_figures(found: Found) -> None:
    result, _, _ = found

    assert re.match(
        r"budgets: 0\.0\S* of 1 MB, \S+ of 1 (modelled )?J", result.lines()[1]
    )
    assert result.lines()[2].startswith("room kept to others: not measured (no route")
    assert "a preview: 8 of 220 routes" in result.lines()


def test_each_file_drives_each_route_once_whatever_was_killed(found: Found) -> None:
    _, engine, _ = found

    assert len(set(engine.driven)) == len(engine.driven)
    # six routes of the killed run; all of float and two finalists, two of the third
    assert len(engine.driven) == 3 * 8 + 2 - 6


def test_it_says_what_is_ahead_and_each_rung(found: Found) -> None:
    result, _, told = found

    assert told[0].startswith("6 schemes; if all are within the budgets, 34 of 56")
    assert told[1].startswith("2 routes: ")
    assert [each.routes for each in result.rungs] == [2, 8]


def test_the_tables_tell_what_became_of_every_scheme(found: Found) -> None:
    result, _, _ = found
    grid, rungs = result.tables()

    assert [row[0].text for row in grid.rows] == ["float, as it is", *result.grid]
    fates = {row[0].text: row[-1].text for row in grid.rows}
    assert fates["without-occ"] == "this one"
    assert fates["without-map"].startswith("dropped after 2 routes, -40.0")
    assert grid.columns[3] in ("J", "modelled J")
    assert len(rungs.rows) == 2
    assert faults("search", json.loads(json.dumps(result.document()))) == []
    assert len(result.records()) == 6


def test_budgets_that_nothing_meets(killed: RoadSearchOptions, model: Path) -> None:
    tight = dataclasses.replace(killed, limits=Limits(max_mb=1e-9))

    with pytest.raises(
        EvaluationError, match=r"^nothing fits 0\.000000001 MB: .*least found"
    ):
        search(model, tight, Scripted(), [])


def test_a_folder_of_another_search(killed: RoadSearchOptions, model: Path) -> None:
    other = dataclasses.replace(killed, latency="fps:10")

    with pytest.raises(StudyError, match=r"of another search: its condition is"):
        search(model, other, Scripted(), [])


def test_a_folder_that_is_none_of_ours(model: Path, tmp_path: Path) -> None:
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives" / "notes.txt").write_text("mine")

    with pytest.raises(StudyError, match=r"not empty, and holds no search\.json"):
        search(model, asked(model, tmp_path / "drives"), Scripted(), [])


def test_a_scheme_that_cannot_be_made_is_reported_and_the_rest_goes_on(
    killed: RoadSearchOptions, model: Path
) -> None:
    both = dataclasses.replace(killed, target="tensorrt", rules="no-such-rules")

    result = search(model, both, Scripted(), [])

    assert "no-such-rules" in result.refused("int8-backbone")
    assert result.winner == "without-occ"
