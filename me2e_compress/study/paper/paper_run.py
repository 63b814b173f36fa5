"""Run the paper's study: drives one by one, kept without their frames."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import Me2eError, StudyError
from me2e_compress.evaluators.highway.engine import Engine, LocalEngine
from me2e_compress.runtime.energy.models import measure_energy
from me2e_compress.runtime.providers import CPU
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.drives import DriveSetup
from me2e_compress.study.outcome import this_machine
from me2e_compress.study.paper.accident import FILE as ACCIDENT
from me2e_compress.study.paper.accident import Accident, first_accident, watched
from me2e_compress.study.paper.model_facts import (
    FILE,
    ModelFacts,
    facts_of,
    load_facts,
    save_facts,
    weighed,
)
from me2e_compress.study.paper.paper_result import PaperResult
from me2e_compress.study.prepared import PreparedVariant, prepare_all
from me2e_compress.study.recorded import recorded
from me2e_compress.study.study_blocks import StudyBlock
from me2e_compress.study.timing import Clock, time_all
from me2e_compress.study.workload import held_frames
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN, Workspace
from me2e_compress.workflows.checks import check_folder
from me2e_compress.workflows.claims import check_ours, writing
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.profile import ProfileOptions, profile

PROFILED = 100
"""Inferences under a profiler, for the figure of modules."""


def run_paper(
    study: Study,
    folder: str | Path,
    engine: Engine | None = None,
    listener: Listener = SILENT,
    on_block: Callable[[PaperResult], None] = lambda result: None,
    weigh: Sequence[Path] = (),
    *,
    force: bool = False,
) -> PaperResult:
    """Make the models, time them and drive every cell, block by block.

    Run again with the same folder it resumes: finished models, traces, routes and cells
    (``records/``) are reused. A variant or cell that fails is reported, and the rest
    continues. ``on_block`` is called after each block driven now; ``weigh`` are folders
    of other stacks' files, counted in table 4.
    """
    folder = Path(folder)
    check_folder(folder, study.inputs(), (JSON, MARKDOWN, HTML))
    check_ours([folder / name for name in (JSON, MARKDOWN, HTML)], force=force)
    with writing(folders=[folder]):
        others = tuple(found for each in weigh for found in weighed(each))
        started = _begun(study, folder, engine or LocalEngine(), listener, others)
        return _all_driven(*started, on_block)


def read_paper(
    study: Study, records: str | Path, weigh: Sequence[Path] = ()
) -> PaperResult:
    """Read finished cells (``records/`` of a run); nothing is made or driven.

    ``weigh`` adds folders of other stacks' files to table 4.
    """
    # finished cells, and facts of their files
    folder = Path(records)
    about, facts = load_facts(folder / FILE)
    found = [DriveRecord.load(path) for path in sorted(folder.glob("*.jsonl"))]
    cells = {(each.variant, each.condition): each for each in found}
    scale = about.get("device_scale")
    if not isinstance(scale, float | int):
        raise StudyError(f"{folder / FILE}: no device_scale")
    # other stacks' files may be counted anew
    names = [each.name for each in study.variants]
    facts |= {found.variant: found for each in weigh for found in weighed(each)}
    weighed_too = (each for each in facts.values() if each.of_another_stack)
    return PaperResult(
        _of_these_routes(study, found, folder),
        (*(facts[name] for name in names if name in facts), *weighed_too),
        cells,
        {},
        float(scale),
        str(about.get("machine", "")),
        Accident.load(folder / ACCIDENT) if (folder / ACCIDENT).is_file() else None,
    )


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


def _begun(
    study: Study,
    folder: Path,
    engine: Engine,
    listener: Listener,
    others: tuple[ModelFacts, ...],
) -> tuple[DriveSetup, Sequence[PreparedVariant], PaperResult]:
    """Make, time and weigh the models; return what drives them."""
    workspace = Workspace(folder)
    study = recorded(study, workspace, listener)
    prepared = prepare_all(study, workspace, listener)
    clock = time_all(study, prepared, workspace, listener)
    facts = _facts(study, prepared, clock, workspace, listener, others)
    result = PaperResult(study, facts, {}, {}, clock.scale, this_machine(clock.load))
    setup = DriveSetup(study, clock, workspace, engine, listener)
    return setup, prepared, result


def _all_driven(
    setup: DriveSetup,
    prepared: Sequence[PreparedVariant],
    result: PaperResult,
    on_block: Callable[[PaperResult], None],
) -> PaperResult:
    records = setup.workspace.folder / "records"
    for block in setup.study.blocks:
        finished = set(records.glob("*.jsonl"))
        result = _driven(block, setup, prepared, result)
        if result.accident is None:
            result = replace(result, accident=_accident(setup, prepared, result))
        if not finished.issuperset(records.glob("*.jsonl")):
            on_block(result)
    return result


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
        record = result.cell(study.baseline, condition.name)
        happened = None if record is None else first_accident(record)
        if record is None or happened is None:
            continue
        # drive the route again, this time watched
        job = setup.job(driver, condition)
        if job is None:
            continue
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
    cells, failures = dict(result.cells), dict(result.failures)
    wanted = (*block.variants, setup.study.baseline)
    for condition in setup.study.conditions:
        for each in prepared:
            key = each.variant.name, condition.name
            of_block = key[0] in wanted and key[1] in block.conditions
            if not of_block or key in cells or key in failures:
                continue
            try:
                cells[key] = setup.record(each, condition)
            except Me2eError as error:
                failures[key] = str(error)
                setup.listener.on_warning(f"{', '.join(key)}: {error}")
    return replace(result, cells=cells, failures=failures)


def _facts(
    study: Study,
    prepared: Sequence[PreparedVariant],
    clock: Clock,
    workspace: Workspace,
    listener: Listener,
    others: tuple[ModelFacts, ...],
) -> tuple[ModelFacts, ...]:
    """Collect facts of every variant, and profile the baseline, unless known."""
    path = workspace.folder / "records" / FILE
    known = load_facts(path)[1] if path.is_file() else {}
    found = list[ModelFacts]()
    for done, each in enumerate(prepared):
        listener.on_progress("weigh", done, len(prepared), each.variant.name)
        facts = facts_of(each, clock, known)
        if each.variant is study.reference and not facts.modules_us:
            facts = replace(facts, modules_us=_by_module(study, each, clock, listener))
        found.append(facts)
    found = [*_with_joules(study, prepared, found, listener), *others]
    names = [each.variant for each in found]
    more = [each for name, each in known.items() if name not in names]
    about = {"machine": this_machine(clock.load), "device_scale": clock.scale}
    save_facts(path, (*found, *more), about)
    return (*found, *(each for each in more if each.of_another_stack))


def _with_joules(
    study: Study,
    prepared: Sequence[PreparedVariant],
    found: Sequence[ModelFacts],
    listener: Listener,
) -> list[ModelFacts]:
    """Measure joules per frame if this machine has a counter."""
    # models whose energy is not known yet
    models = {
        each.variant.name: each.model
        for each, facts in zip(prepared, found, strict=True)
        if each.model is not None and facts.joules is None
    }
    if study.held_out is None or not models:
        return list(found)
    # all models are measured in one run
    measured = measure_energy(
        models,
        CalibrationSet(study.held_out),
        threads=study.timing.threads,
        provider=study.provider,
        on_window=lambda done, total, name: listener.on_progress(
            "energy", done, total, name
        ),
    )
    return [
        each.with_energy(measured[each.variant]) if each.variant in measured else each
        for each in found
    ]


def _by_module(
    study: Study, prepared: PreparedVariant, clock: Clock, listener: Listener
) -> dict[str, tuple[int, ...]]:
    """Profile a model, on the scale of the device."""
    on_cpu = study.provider.native == CPU.native  # elsewhere nodes are not timed
    if prepared.model is None or study.held_out is None or not on_cpu:
        return {}
    options = ProfileOptions(
        samples=PROFILED,
        by_module=True,
        module_map=prepared.variant.module_map,
        threads=study.timing.threads,
    )
    trace = profile(prepared.model, study.held_out, None, options, listener).trace
    return {
        module: tuple(round(each * clock.scale) for each in samples)
        for module, samples in trace.modules_us.items()
    }
