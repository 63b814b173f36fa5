"""Models and drives of a search on the road, each made once and kept."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import StudyError
from me2e_compress.evaluators.highway.engine import Engine
from me2e_compress.metrics.differences import PairedDifference, difference
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.metrics.route_values import DS
from me2e_compress.registry import documents
from me2e_compress.runtime.atomic import write_json
from me2e_compress.simulator.routes import Route
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import first_difference
from me2e_compress.study.drives import DriveSetup
from me2e_compress.study.on_road.road_options import Weighed
from me2e_compress.study.prepared import PreparedVariant, prepare_all
from me2e_compress.study.timing import time_all
from me2e_compress.study.workspace import Workspace
from me2e_compress.version import __version__
from me2e_compress.workflows.budgets import Joules, joules_of
from me2e_compress.workflows.listener import Listener

ASKED = "search.json"
"""File of what decides the drives of a folder; budgets and grid do not."""


@dataclass(frozen=True)
class RoadDrives:
    """Schemes that are made and weighed; identical files share the first model."""

    setup: DriveSetup
    prepared: Mapping[str, PreparedVariant]
    weighed: Mapping[str, Weighed]
    failures: Mapping[str, str]
    joules: Joules

    @property
    def study(self) -> Study:
        """The study whose variants these are."""
        return self.setup.study

    def same_as(self, name: str) -> str:
        """Return the first scheme with the same file; empty for the first itself."""
        first = self.prepared.get(name)
        return "" if first is None or first.variant.name == name else first.variant.name

    def driven(self, name: str, routes: Sequence[Route]) -> list[RouteSummary]:
        """Drive what is missing of some routes; return them in order."""
        (condition,) = self.study.conditions
        episodes = self.setup.some(self.prepared[name], condition, routes)
        return [RouteSummary.of(each) for each in episodes]

    def differ(self, name: str, routes: Sequence[Route]) -> list[float]:
        """Return the driving score minus the float model's, in points, by route."""
        if self.prepared[name].variant.name == self.study.baseline:
            return [0.0] * len(routes)
        ours, theirs = (self.driven(e, routes) for e in (name, self.study.baseline))
        return list((DS.values(ours) - DS.values(theirs)).by_route.values())

    def difference(self, name: str) -> PairedDifference:
        """Return the difference from the float model over all routes."""
        routes, baseline = self.study.routes, self.study.baseline
        ours, theirs = (self.driven(each, routes) for each in (name, baseline))
        return difference(ours, theirs, self.study.seed)


def make_drives(
    study: Study,
    folder: Path,
    joules: Joules,
    engine: Engine,
    listener: Listener,
) -> RoadDrives:
    """Make and weigh the models of a study; one that fails does not stop the others.

    The study has one condition; latency is measured on its frames.
    """
    # make the models; identical files count once
    _claim(study, folder)
    workspace = Workspace(folder)
    made = prepare_all(study, workspace, listener)
    failures = {each.variant.name: each.failure for each in made if each.failure}
    by_file = dict[str | None, PreparedVariant]()
    for each in made:
        if not each.failure:
            by_file.setdefault(each.sha256, each)
    firsts = list(by_file.values())
    # time and weigh each distinct file
    clock = time_all(study, firsts, workspace, listener)
    spent = _joules(study, firsts, joules, listener)
    weighed = dict[str, Weighed]()
    for each in firsts:
        name, median = each.variant.name, clock.latency(each.variant.name, 50)
        if each.model is None or median.value is None:
            raise StudyError(f"variant {name}: {each.variant.policy} is not a model")
        size = graph.size(graph.load(each.model)).weight_bytes
        weighed[name] = Weighed(size / 1e6, median.value, spent[name])
    # every scheme shares the results of its file
    prepared = {
        each.variant.name: by_file[each.sha256] for each in made if not each.failure
    }
    setup = DriveSetup(study, clock, workspace, engine, listener)
    costs = {name: weighed[each.variant.name] for name, each in prepared.items()}
    return RoadDrives(setup, prepared, costs, failures, joules)


def _joules(
    study: Study,
    made: Sequence[PreparedVariant],
    kind: Joules,
    listener: Listener,
) -> dict[str, float]:
    if study.frames is None:
        raise StudyError(f"{study.title}: there are no frames")
    return joules_of(
        kind,
        {each.variant.name: each.model for each in made if each.model is not None},
        CalibrationSet(study.frames),
        module_map=study.reference.module_map,
        threads=study.timing.threads,
        provider=study.provider,
        on_window=partial(listener.on_progress, "energy"),
    )


def _claim(study: Study, folder: Path) -> None:
    """Write what decides the drives, or check that an existing folder agrees."""
    # an empty folder is claimed, any other one must match
    asked, path = _decisive(study), folder / ASKED
    with documents.reading(path, StudyError, "not JSON"):
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            if any(not each.name.startswith(".") for each in folder.iterdir()):
                raise StudyError(f"{folder}: not empty, and holds no {ASKED}")
            write_json(path, asked, indent=1)
            return
        before = documents.from_json(documents.content(path))
    # what decides the drives must be the same
    before = before if isinstance(before, dict) else {}
    if other := first_difference(before, asked):
        raise StudyError(f"{folder}: of another search: {other}; choose another folder")


def _decisive(study: Study) -> dict[str, Any]:
    if study.frames is None:
        raise StudyError(f"{study.title}: there are no frames")
    (condition,), reference = study.conditions, study.reference
    found = {
        "version": __version__,
        "model": graph.sha256_of(Path(reference.policy)),
        "frames": CalibrationSet(study.frames).fingerprint,
        "routes": [each.record() for each in study.routes],
        "condition": condition.to_json(),
        "timing": asdict(study.timing),
        "seed": study.seed,
        "adapter": None if reference.adapter is None else reference.adapter.read_text(),
    }
    plain = json.loads(json.dumps(found))
    return dict(plain)
