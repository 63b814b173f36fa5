"""Run a study."""

from dataclasses import replace
from pathlib import Path

from me2e_compress.errors import StudyError
from me2e_compress.evaluators.highway.engine import Engine, LocalEngine
from me2e_compress.manager.report import versions
from me2e_compress.study.definition import Study
from me2e_compress.study.drives import DriveSetup
from me2e_compress.study.file import load_study
from me2e_compress.study.outcome import VariantOutcome, this_machine
from me2e_compress.study.plan_fidelity import judge
from me2e_compress.study.prepared import PreparedVariant, prepare_all
from me2e_compress.study.side_by_side import take_pictures
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.timing import time_all
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN, Workspace
from me2e_compress.workflows.checks import check_folder, check_ours, writing
from me2e_compress.workflows.frames import record_frames
from me2e_compress.workflows.options import FramesOptions
from me2e_compress.workflows.result import SILENT, Listener


def run_study(
    study: Study | str | Path,
    folder: str | Path,
    engine: Engine | None = None,
    listener: Listener = SILENT,
    pictures: int = 3,
    *,
    force: bool = False,
) -> StudyResult:
    """Make the models, time them, compare them with the baseline, drive them.

    With the same folder it resumes: finished models, traces and routes are reused.
    Studies may share a folder if they share variants. Every drive of highway leaves a
    line a route in ``records/``.

    Args:
        study: A study, or its TOML file.
        folder: Where models, traces and results go.
        engine: Where routes are driven; None for one process of this machine. An
            evaluator other than highway ignores it.
        listener: Is called with progress and warnings.
        pictures: Number of routes on which two drives are shown side by side.
        force: Also replace a report that we did not write.

    Raises:
        GraphError: The folder is a file or an input.
        Me2eError: The baseline cannot drive, frames do not fit, or the folder belongs
            to another study. Another variant that fails is left out, with a warning.
    """
    study, folder = _read(study), Path(folder)
    if study.elsewhere and engine not in (None, LocalEngine()):
        raise StudyError(
            f"workers and engine are highway's: {study.evaluator} drives where it will"
        )
    check_folder(folder, study.inputs(), (JSON, MARKDOWN, HTML))
    check_ours([folder / name for name in (JSON, MARKDOWN, HTML)], force=force)
    with writing(folders=[folder]):
        begun = prepare_study(study, folder, engine or LocalEngine(), listener)
        return _compared(*begun, pictures)


def prepare_study(
    study: Study, folder: Path, engine: Engine, listener: Listener
) -> tuple[DriveSetup, list[PreparedVariant]]:
    """Record frames, make the models and time them; return what drives them."""
    workspace = Workspace(folder)
    study = _recorded(study, workspace, listener)
    prepared = prepare_all(study, workspace, listener)
    clock = time_all(study, prepared, workspace, listener)
    return DriveSetup(study, clock, workspace, engine, listener), prepared


def _recorded(study: Study, workspace: Workspace, listener: Listener) -> Study:
    """Return the study with folders of frames, recorded unless they exist.

    The held-out frames use the next seed, hence other routes.
    """
    asked = study.to_record
    if asked is None:
        return study
    model = Path(study.reference.policy)
    # calibration frames, and held-out frames of the next seed
    folders = list[Path]()
    for name, count, seed in (
        ("frames", asked.frames, asked.seed),
        ("frames-held-out", asked.held_out, asked.seed + 1),
    ):
        folder = workspace.folder / name
        if not (folder / "scenes.json").is_file():
            folder.parent.mkdir(parents=True, exist_ok=True)
            options = FramesOptions(count=count, seed=seed, provider=study.provider)
            record_frames(model, folder, options, listener)
        folders.append(folder)
    frames, held_out = folders
    return replace(study, frames=frames, held_out=held_out, to_record=None)


def _compared(
    setup: DriveSetup, prepared: list[PreparedVariant], pictures: int
) -> StudyResult:
    """Compare the plans and the drives of every variant with the baseline's."""
    study, clock = setup.study, setup.clock
    baseline = next(each for each in prepared if each.variant is study.reference)
    variants = tuple(
        VariantOutcome.of(each, clock, judge(study, baseline, each, setup.listener))
        for each in prepared
    )
    drives = [
        drive
        for condition in study.conditions
        for drive in setup.under(condition, prepared)
    ]
    # only highway can show two drives side by side
    contrasts = (
        () if study.elsewhere else take_pictures(setup, prepared, drives, pictures)
    )
    return StudyResult(
        study,
        variants,
        tuple(drives),
        contrasts,
        clock.scale,
        this_machine(),
        versions(),
        clock.load,
    )


def _read(study: Study | str | Path) -> Study:
    if isinstance(study, str | Path):
        return load_study(study)
    study.check_recordings()
    return study
