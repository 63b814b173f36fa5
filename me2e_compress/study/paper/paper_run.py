"""Run the paper's study: drives one by one, kept without their frames."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from me2e_compress.errors import Me2eError, StudyError
from me2e_compress.manager.report import versions
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.drives import DriveSetup
from me2e_compress.study.outcome import this_machine
from me2e_compress.study.paper.accident import FILE as ACCIDENT
from me2e_compress.study.paper.accident import Accident, first_accident, watched
from me2e_compress.study.paper.paper_drives import FILE, KeptFacts, ModelFacts
from me2e_compress.study.paper.paper_result import PaperResult
from me2e_compress.study.paper.questions import FILE as QUESTIONS
from me2e_compress.study.paper.questions import SHIPPED, PaperQuestions
from me2e_compress.study.paper.weigh import weigh, weighed
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.study_blocks import StudyBlock
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.workload import held_frames


def drive_blocks(
    setup: DriveSetup,
    prepared: Sequence[PreparedVariant],
    on_block: Callable[[StudyResult], None] | None,
    others: tuple[ModelFacts, ...] = (),
) -> PaperResult:
    """Weigh the models and drive every cell, block by block.

    Finished cells (``records/``) are reused. A cell that fails is reported, and the
    rest continues. ``on_block`` is called after each block driven now; ``others`` are
    facts about other stacks' files, for table 4.
    """
    study, clock = setup.study, setup.clock
    records = setup.workspace.folder / "records"
    asked = _asked(study, records)
    setup = replace(setup, questions=asked.sha256 if asked else "")
    facts = weigh(setup, prepared, others)
    machine = this_machine(clock.load)
    result = PaperResult(
        *(study, (), (), (), clock.scale, machine, versions()),
        facts=facts,
        asked=asked,
    )
    for block in study.blocks:
        finished = set(records.glob("*.jsonl"))
        result = _driven(block, setup, prepared, result)
        if result.accident is None:
            result = replace(result, accident=_accident(setup, prepared, result))
        driven_now = not finished.issuperset(records.glob("*.jsonl"))
        if on_block is not None and driven_now:
            on_block(result)
    return result


def read_paper(
    study: Study, records: str | Path, stacks: Sequence[Path] = ()
) -> PaperResult:
    """Read finished cells (``records/`` of a run); nothing is made or driven.

    ``stacks`` are folders of other stacks' files, for table 4.
    """
    # finished cells, and facts of their files
    folder = Path(records)
    accident = folder / ACCIDENT
    kept = KeptFacts.load(folder / FILE)
    found = [DriveRecord.load(path) for path in sorted(folder.glob("*.jsonl"))]
    # other stacks' files may be counted anew
    names = [each.name for each in study.variants]
    more = {found.variant: found for each in stacks for found in weighed(each)}
    facts = kept.by_variant | more
    weighed_too = (each for each in facts.values() if each.of_another_stack)
    return PaperResult(
        _of_these_routes(study, found, folder),
        (),
        tuple(found),
        (),
        kept.device_scale,
        kept.machine,
        {},
        facts=(*(facts[name] for name in names if name in facts), *weighed_too),
        accident=Accident.load(accident) if accident.is_file() else None,
        asked=_kept_questions(folder),
    )


def _asked(study: Study, records: Path) -> PaperQuestions | None:
    """Keep a copy of the questions before the first drive, and return it.

    None in a folder whose first drive was made without one: nobody knows what it was
    made for.
    """
    now = study.questions or SHIPPED
    PaperQuestions.load(now)
    if not (records.is_dir() or (records.parent / "results").is_dir()):
        records.mkdir(parents=True)
        write_bytes(records / QUESTIONS, now.read_bytes())
    return _kept_questions(records)


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
    return replace(study, routes=routes, set_size=found[0].set_size)


def _accident(
    setup: DriveSetup, prepared: Sequence[PreparedVariant], result: PaperResult
) -> Accident | None:
    """Return the baseline's first accident, at the highest rate that has one."""
    # an accident is recorded once
    path = setup.workspace.folder / "records" / ACCIDENT
    if path.is_file():
        return Accident.load(path)
    # the highest rate comes first
    study = setup.study
    driver = next(each for each in prepared if each.variant is study.reference)
    for condition in sorted(study.conditions, key=partial(held_frames, study)):
        record = result.drive(study.baseline, condition.name)
        happened = first_accident(record)
        job = None if happened is None else setup.job(driver, condition)
        if happened is None or job is None:
            continue
        # drive the route again, this time watched
        route = next(each for each in study.routes if each.id == happened.route)
        found = watched(record, happened, route, job)
        if found.moments:
            found.save(path)
            return found
    return None


def _driven(
    block: StudyBlock,
    setup: DriveSetup,
    prepared: Sequence[PreparedVariant],
    result: PaperResult,
) -> PaperResult:
    """Drive the new cells of a block; a failing one does not stop the others."""
    drives = list(result.drives)
    done = {(each.variant, each.condition) for each in drives}
    wanted = (*block.variants, setup.study.baseline)
    for condition in setup.study.conditions:
        for each in prepared:
            key = each.variant.name, condition.name
            of_block = key[0] in wanted and key[1] in block.conditions
            if not of_block or key in done:
                continue
            try:
                drives.append(setup.record(each, condition))
            except Me2eError as error:
                drives.append(DriveRecord(*key, reason=str(error)))
                setup.listener.on_warning(f"{', '.join(key)}: {error}")
    return replace(result, drives=tuple(drives))
