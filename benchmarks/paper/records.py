"""Records of the paper's study: the drives that it left, and facts of its files."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from benchmarks.paper.accident import FILE as ACCIDENT
from benchmarks.paper.accident import Accident, accident_of, first_accident
from benchmarks.paper.drives import FILE, KeptFacts
from benchmarks.paper.periods import frames_per_decision
from benchmarks.paper.questions import FILE as QUESTIONS
from benchmarks.paper.questions import SHIPPED, PaperQuestions
from benchmarks.paper.result import PaperResult
from benchmarks.paper.weigh import weigh, weighed
from me2e_compress.base.errors import StudyError
from me2e_compress.evaluators.highway import runner
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.simulator.pictures import Moment
from me2e_compress.simulator.routes import Route
from me2e_compress.study import Listener, Study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.run import StudyCells, prepare_study
from me2e_compress.study.workspace import Workspace

RECORDS = "records"
"""Folder of a study's folder that holds a line a route of every drive."""


def add_facts(
    study: Study, folder: Path, stacks: Sequence[Path], listener: Listener
) -> None:
    """Weigh the files of a study that was driven, and record an accident.

    Models and traces are those of the study's folder; what its ``records/`` has is not
    measured again. ``stacks`` are folders of other stacks' files, for table 4.

    Raises:
        StudyError: The folder is not that of a study.
    """
    if not (folder / RECORDS).is_dir():
        raise StudyError(f"{folder}: holds no {RECORDS}: drive the study first")
    setup, prepared = prepare_study(study, folder, LocalEngine(), listener)
    weigh(setup, prepared, [found for each in stacks for found in weighed(each)])
    _keep_accident(setup, prepared)


def read_paper(study: Study, folder: Path, questions: Path = SHIPPED) -> PaperResult:
    """Read finished drives (``records/`` of a study); nothing is made or driven."""
    # finished drives, and facts of their files
    accident = folder / ACCIDENT
    kept = KeptFacts.load(folder / FILE)
    paths = sorted(path for path in folder.glob("*.jsonl") if path.name in files(study))
    found = [DriveRecord.load(path) for path in paths]
    names = [each.name for each in study.variants]
    facts = kept.by_variant
    weighed_too = (each for each in kept.variants if each.of_another_stack)
    return PaperResult(
        _of_these_routes(study, found, folder),
        tuple(found),
        kept.device_scale,
        kept.machine,
        facts=(*(facts[name] for name in names if name in facts), *weighed_too),
        accident=Accident.load(accident) if accident.is_file() else None,
        questions=questions,
        asked=_kept_questions(folder),
        asked_of=dict(map(_asked_of, paths)),
    )


def files(study: Study) -> set[str]:
    """Return the names of the records of a study; its folder may hold another's too."""
    return {
        f"{Workspace.drive(variant, each)}.jsonl"
        for each in study.conditions
        for variant in study.driven_under(each)
    }


def _asked_of(path: Path) -> tuple[str, str]:
    """Return a drive's name, and the digest of its questions that its record has."""
    with path.open(encoding="utf-8") as lines:
        head = json.loads(next(lines))
    return f"{head['variant']}.{head['condition']}", head.get("questions", "")


def _kept_questions(records: Path) -> PaperQuestions | None:
    kept = records / QUESTIONS
    return PaperQuestions.load(kept) if kept.is_file() else None


def _of_these_routes(study: Study, found: Sequence[DriveRecord], folder: Path) -> Study:
    """Return the study over the routes that all cells drove."""
    sets = {each.made_by.get("routes_sha256") for each in found}
    if len(sets) > 1:
        raise StudyError(f"{folder}: drives of different sets of routes")
    if not found:
        return study
    names = {each.route for each in found[0].routes}
    routes = tuple(each for each in study.routes if each.id in names)
    if len(routes) < len(names):
        raise StudyError(f"{folder}: drives of routes that this study has not")
    return replace(study, routes=routes, set_size=found[0].made_by["set_size"])


def _keep_accident(setup: StudyCells, prepared: Sequence[PreparedVariant]) -> None:
    """Record the baseline's first accident, at the highest rate that has one, once."""
    path = setup.workspace.folder / RECORDS / ACCIDENT
    if path.is_file():
        return
    # the highest rate comes first
    study = setup.study
    driver = next(each for each in prepared if each.variant is study.reference)
    for condition in sorted(study.conditions, key=partial(frames_per_decision, study)):
        file = setup.workspace.record(study.reference, condition)
        record = DriveRecord.load(file) if file.is_file() else None
        happened = None if record is None else first_accident(record)
        drive = None if happened is None else setup.drive(driver, condition)
        if record is None or happened is None or drive is None:
            continue
        # drive the route again, this time watched
        routes = (each for each in study.routes if isinstance(each, Route))
        route = next(each for each in routes if each.id == happened.route)
        moments = list[Moment]()
        seeing = runner.Listeners(on_moment=moments.append)
        runner.drive(route, driver.driver.open(), drive, seeing)
        found = accident_of(record, happened, route, moments)
        if found.moments:
            found.save(path)
            return
