"""Run a study: prepare the variants, drive each under each condition, record it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from me2e_compress.base.errors import StudyError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.commands.checks import check_folder, check_replaceable, writing
from me2e_compress.commands.frames import record_frames
from me2e_compress.commands.options import FramesOptions
from me2e_compress.driving.latency import FixedLatency
from me2e_compress.evaluators.contract import Drive, Engine
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.results import MEASURED, ResultsFolder, drive_routes
from me2e_compress.manager.report import versions
from me2e_compress.metrics.route_summary import difference
from me2e_compress.metrics.scores import score
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, load_study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.outcome import Clock, compare_plans, this_machine, time_all
from me2e_compress.study.prepared import PreparedVariant, prepare_all
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN, Workspace


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
    # Check everything before any work
    study = load_study(study) if isinstance(study, str | Path) else study
    study.check()
    if engine not in (None, LocalEngine()):
        study.driven_by.check_takes(["engine"], "workers and engine: ")
    folder = Path(folder)
    check_folder(folder, study.inputs(), (JSON, MARKDOWN, HTML))
    check_replaceable([folder / name for name in (JSON, MARKDOWN, HTML)], force=force)
    with writing(folders=[folder]):
        cells, prepared = prepare_study(study, folder, engine, listener)
        # Compare plans and drives of every variant with the baseline's
        study, clock = cells.study, cells.clock
        baseline = next(entry for entry in prepared if entry.variant == study.reference)
        variants, drives = list[PreparedVariant](), list[DriveRecord]()
        for entry in prepared:
            fidelity = compare_plans(study, baseline, entry, listener)
            latencies = clock.latencies(entry)
            variants.append(replace(entry, latency_ms=latencies, fidelity=fidelity))
        for condition in study.conditions:
            drives += cells.drive_variants(condition, prepared)
        return StudyResult(
            study,
            tuple(variants),
            tuple(drives),
            clock.scale,
            this_machine(),
            versions(),
            clock.load,
        )


def prepare_study(
    study: Study, folder: Path, engine: Engine | None, listener: Listener
) -> tuple["StudyCells", list[PreparedVariant]]:
    """Record frames, make the models and time them; return what drives them."""
    # Record frames unless they exist; held-out ones are of the next seed's routes
    workspace, wanted, baseline = Workspace(folder), study.to_record, study.reference
    if wanted is not None:
        frames, held_out = folder / "frames", folder / "frames-held-out"
        counts = {frames: wanted.frames, held_out: wanted.held_out}
        for seed, (place, count) in enumerate(counts.items(), wanted.seed):
            if not (place / "scenes.json").is_file():
                folder.mkdir(parents=True, exist_ok=True)
                options = FramesOptions(
                    count=count,
                    seed=seed,
                    adapter=baseline.adapter,
                    provider=study.provider,
                    module_map=baseline.module_map,
                )
                record_frames(Path(baseline.policy), place, options, listener)
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

    def drive_variants(
        self, condition: Condition, prepared: Sequence[PreparedVariant]
    ) -> list[DriveRecord]:
        """Drive the variants of one condition, the baseline first."""
        driven, baseline = self.study.driven_under(condition), self.study.baseline
        prepared = [entry for entry in prepared if entry.variant in driven]
        # The baseline drives first: others are compared with it
        ordered = sorted(prepared, key=lambda entry: entry.name != baseline)
        records = {entry.name: self._drive_cell(entry, condition) for entry in ordered}
        for name, record in records.items():
            if name != baseline and record.routes and records[baseline].routes:
                reference, seed = records[baseline].routes, self.study.seed
                gap = difference(record.routes, reference, seed)
                records[name] = replace(record, difference=gap)
        return [records[entry.name] for entry in prepared]

    def drive(self, prepared: PreparedVariant, condition: Condition) -> Drive | None:
        """Return what a cell drives; None without a driver or its latency."""
        study, name = self.study, condition.name
        if prepared.failure:
            return None
        if not condition.mean_of:
            latency = self.clock.source(prepared.variant, condition, study.seed)
        else:
            # The mean decision of a drive, which must be done
            if name not in self.means_us:
                path = self.workspace.record(*study.drive_of(condition.mean_of))
                done = DriveRecord.load(path) if path.is_file() else None
                if done is None or done.mean_latency_us is None:
                    words = f"{condition.mean_of} took no decision"
                    raise StudyError(f"condition {name}: {words}")
                self.means_us[name] = done.mean_latency_us
            latency = FixedLatency(self.means_us[name])
        if latency is None:
            return None
        return replace(
            condition.drive,
            latency=latency,
            engine=self.engine,
            routes=study.routes,
            set_size=study.set_size,
        )

    def _drive_cell(
        self, prepared: PreparedVariant, condition: Condition
    ) -> DriveRecord:
        """Drive a variant under a condition, or resume it; record and score it."""
        study, names = self.study, (prepared.name, condition.name)
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
