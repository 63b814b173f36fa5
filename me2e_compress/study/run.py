"""Run a study: prepare the variants, drive each under each condition, record it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from me2e_compress.driving.latency import FixedLatency
from me2e_compress.errors import StudyError
from me2e_compress.evaluators.contract import Drive, Engine
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.results import MEASURED, ResultsFolder, drive_routes
from me2e_compress.manager.report import versions
from me2e_compress.metrics.route_summary import difference
from me2e_compress.metrics.scores import score
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.file import load_study
from me2e_compress.study.outcome import (
    Clock,
    judge,
    this_machine,
    time_all,
)
from me2e_compress.study.prepared import PreparedVariant, prepare_all
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN, Workspace
from me2e_compress.workflows.checks import check_folder, check_replaceable, writing
from me2e_compress.workflows.frames import record_frames
from me2e_compress.workflows.options import FramesOptions
from me2e_compress.workflows.result import SILENT, Listener


def run_study(
    study: Study | str | Path,
    folder: str | Path,
    engine: Engine | None = None,
    listener: Listener = SILENT,
    *,
    force: bool = False,
) -> StudyResult:
    """Make the models, time them, compare them with the baseline, drive them.

    With the same folder it resumes: finished models, traces and routes are reused.
    Studies may share a folder if they share variants. Every drive leaves a line a route
    in ``records/``.

    Args:
        study: A study, or its TOML file.
        folder: Where models, traces and results go.
        engine: Where routes are driven; None for one process of this machine.
        listener: Is called with progress and warnings.
        force: Also replace a report that we did not write.

    Raises:
        GraphError: The folder is a file or an input.
        Me2eError: The baseline cannot drive, frames do not fit, or the folder belongs
            to another study. Another variant that fails is left out, with a warning.
    """
    # check everything before any work
    study = load_study(study) if isinstance(study, str | Path) else study
    study.check()
    if engine not in (None, LocalEngine()):
        study.driven_by.check_takes(["engine"], "workers and engine: ")
    folder = Path(folder)
    check_folder(folder, study.inputs(), (JSON, MARKDOWN, HTML))
    check_replaceable([folder / name for name in (JSON, MARKDOWN, HTML)], force=force)
    with writing(folders=[folder]):
        cells, prepared = prepare_study(study, folder, engine, listener)
        # plans and drives of every variant are compared with the baseline's
        study, clock = cells.study, cells.clock
        baseline = next(each for each in prepared if each.variant == study.reference)
        variants = [
            replace(
                each,
                latency_ms=clock.latencies(each),
                fidelity=judge(study, baseline, each, listener),
            )
            for each in prepared
        ]
        drives = tuple(
            drive
            for condition in study.conditions
            for drive in cells.under(condition, prepared)
        )
        made_by = this_machine(), versions()
        return StudyResult(
            *(study, tuple(variants), drives, clock.scale, *made_by, clock.load)
        )


def prepare_study(
    study: Study, folder: Path, engine: Engine | None, listener: Listener
) -> tuple["StudyCells", list[PreparedVariant]]:
    """Record frames, make the models and time them; return what drives them."""
    # frames are recorded unless they exist; those held out are of the next seed, so
    # of other routes
    workspace, asked = Workspace(folder), study.to_record
    if asked is not None:
        frames, held_out = folder / "frames", folder / "frames-held-out"
        for place, count, seed in (
            (frames, asked.frames, asked.seed),
            (held_out, asked.held_out, asked.seed + 1),
        ):
            if not (place / "scenes.json").is_file():
                folder.mkdir(parents=True, exist_ok=True)
                by, provider = study.reference, study.provider
                options = FramesOptions(
                    count=count, seed=seed, adapter=by.adapter, provider=provider,
                    module_map=by.module_map,
                )  # fmt: skip
                record_frames(Path(by.policy), place, options, listener)
        study = replace(study, frames=frames, held_out=held_out, to_record=None)
    prepared = prepare_all(study, workspace, listener)
    clock = time_all(study, prepared, workspace, listener)
    return StudyCells(study, clock, workspace, engine, listener), prepared


@dataclass(frozen=True)
class StudyCells:
    """Drives variants under conditions; ``means_us`` caches those of ``mean_of``."""

    study: Study
    clock: Clock
    workspace: Workspace
    engine: Engine | None
    listener: Listener
    means_us: dict[str, int] = field(default_factory=dict)

    def under(
        self, condition: Condition, prepared: Sequence[PreparedVariant]
    ) -> tuple[DriveRecord, ...]:
        """Drive the variants of one condition, the baseline first."""
        driven, baseline = self.study.driven_under(condition), self.study.baseline
        prepared = [each for each in prepared if each.variant in driven]
        # the baseline drives first: others are compared with it
        ordered = sorted(prepared, key=lambda each: each.variant.name != baseline)
        records = {e.variant.name: self._driven(e, condition) for e in ordered}
        for name, record in records.items():
            if name != baseline and record.routes and records[baseline].routes:
                reference, seed = records[baseline].routes, self.study.seed
                gap = difference(record.routes, reference, seed)
                records[name] = replace(record, difference=gap)
        return tuple(records[each.variant.name] for each in prepared)

    def drive(self, prepared: PreparedVariant, condition: Condition) -> Drive | None:
        """Return what a cell drives; None without a driver or its latency."""
        if prepared.failure:
            return None
        if not condition.mean_of:
            latency = self.clock.source(prepared.variant, condition, self.study.seed)
        else:
            if condition.name not in self.means_us:
                self.means_us[condition.name] = self._mean_us(condition)
            latency = FixedLatency(self.means_us[condition.name])
        if latency is None:
            return None
        return replace(
            condition.drive,
            latency=latency,
            routes=self.study.routes,
            set_size=self.study.set_size,
            engine=self.engine,
        )

    def _mean_us(self, condition: Condition) -> int:
        """Return the mean decision of a drive, which must be done."""
        path = self.workspace.record(*self.study.drive_of(condition.mean_of))
        mean_us = DriveRecord.load(path).mean_latency_us if path.is_file() else None
        if mean_us is None:
            raise StudyError(
                f"condition {condition.name}: {condition.mean_of} took no decision"
            )
        return mean_us

    def _driven(self, prepared: PreparedVariant, condition: Condition) -> DriveRecord:
        """Drive a cell, or go on; record and score it. No routes without a drive."""
        study, names = self.study, (prepared.variant.name, condition.name)
        drive = self.drive(prepared, condition)
        if drive is None:
            why = f"its latency was not measured: {self.clock.reason}"
            if prepared.failure or prepared.model is None:
                why = prepared.failure or "no model: it has no latency of its own"
            return DriveRecord(*names, reason=why)
        evaluator, policy = study.driven_by, prepared.driver
        folder = self.workspace.results(prepared.variant, condition)
        stage = ", ".join(names)
        episodes = drive_routes(evaluator, policy, drive, folder, self.listener, stage)
        made_by = dict(ResultsFolder.open(folder).made_by)
        made_by.pop(MEASURED, None)  # of the trace, which the latency names
        record = DriveRecord.of(*names, made_by, episodes)
        record.save(self.workspace.record(prepared.variant, condition))
        set_size = study.set_size or evaluator.set_size or len(episodes)
        return replace(record, scores=score(episodes, set_size, study.seed))
