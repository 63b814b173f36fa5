"""Drive and score every variant under every condition."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from me2e_compress.driving.latency import FixedLatency, LatencySource
from me2e_compress.errors import StudyError
from me2e_compress.evaluators.highway.drivers import image_size_of
from me2e_compress.evaluators.highway.engine import Engine
from me2e_compress.evaluators.highway.evaluator import DrivingProgress, HighwayEvaluator
from me2e_compress.evaluators.highway.results import fingerprint
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.route_summary import difference
from me2e_compress.metrics.scores import score
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import DriveRecord, apart
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.timing import Clock
from me2e_compress.study.workspace import Workspace
from me2e_compress.workflows.other_evaluators import (
    driven_episodes,
    evaluator_named,
    keep,
    kept,
)
from me2e_compress.workflows.result import Listener


@dataclass(frozen=True)
class DriveSetup:
    """What all drives share; ``means_us`` caches means for ``mean_of`` conditions."""

    study: Study
    clock: Clock
    workspace: Workspace
    engine: Engine
    listener: Listener
    means_us: dict[str, int] = field(default_factory=dict)
    image_sizes: dict[str, tuple[int, int]] = field(default_factory=dict)

    def under(
        self, condition: Condition, prepared: Sequence[PreparedVariant]
    ) -> tuple[DriveRecord, ...]:
        """Drive the variants of one condition, the baseline first."""
        driven = self.study.driven_under(condition)
        prepared = [each for each in prepared if each.variant in driven]
        if not prepared:
            return ()
        names = [each.variant.name for each in prepared]
        baseline = prepared[names.index(self.study.baseline)]
        episodes = self._episodes(baseline, condition)
        reference = self._scored(baseline, condition, episodes)
        return tuple(
            reference
            if each is baseline
            else self._compared(each, condition, reference, episodes)
            for each in prepared
        )

    def job(self, prepared: PreparedVariant, condition: Condition) -> Job | None:
        """Return driver and conditions; None if they or the latency are unknown."""
        if prepared.failure:
            return None
        latency = self._latency(prepared, condition)
        if latency is None:
            return None
        name = prepared.variant.name
        if name not in self.image_sizes:  # opening a model takes half a second
            self.image_sizes[name] = image_size_of(prepared.driver.open())
        size = self.image_sizes[name]
        return Job(prepared.driver, condition.drives(latency, size))

    def _latency(
        self, prepared: PreparedVariant, condition: Condition
    ) -> LatencySource | None:
        """Return the latency of decisions; a mean needs its drive to be done."""
        if not condition.mean_of:
            return self.clock.source(prepared.variant, condition, self.study.seed)
        if condition.name not in self.means_us:
            self.means_us[condition.name] = self._mean_us(condition)
        return FixedLatency(self.means_us[condition.name])

    def _mean_us(self, condition: Condition) -> int:
        variant, under = condition.mean_cell
        by_name = {each.name: each for each in self.study.variants}
        conditions = {each.name: each for each in self.study.conditions}
        path = self.workspace.record(by_name[variant], conditions[under])
        mean_us = DriveRecord.load(path).mean_latency_us if path.is_file() else None
        if mean_us is None:
            raise StudyError(
                f"condition {condition.name}: {condition.mean_of} took no decision"
            )
        return mean_us

    def _why_not(self, prepared: PreparedVariant) -> str:
        if prepared.failure or prepared.model is None:
            return prepared.failure or "no model: it has no latency of its own"
        return f"its latency was not measured: {self.clock.reason}"

    def _episodes(
        self, prepared: PreparedVariant, condition: Condition
    ) -> tuple[Episode, ...] | None:
        if self.study.elsewhere:
            return self._episodes_elsewhere(prepared, condition)
        job = self.job(prepared, condition)
        if job is None:
            return None
        evaluator = HighwayEvaluator(
            job,
            self.study.routes,
            self.workspace.results(prepared.variant, condition),
            self.study.set_size,
            self.engine,
            self._teller(f"{prepared.variant.name}, {condition.name}"),
            self.listener.on_warning,
        )
        return tuple(evaluator.episodes())

    def _episodes_elsewhere(
        self, prepared: PreparedVariant, condition: Condition
    ) -> tuple[Episode, ...] | None:
        if prepared.failure:
            return None
        # the policy becomes the evaluator's option of that name
        evaluator, variant = self.study.evaluator, prepared.variant
        stage = f"{variant.name}, {condition.name}"
        self.listener.on_progress(stage, 0, 1, evaluator)
        policy = variant.policy if prepared.model is None else str(prepared.model)
        found = evaluator_named(evaluator, policy)
        # from its folder if they were kept
        folder = self.workspace.results(variant, condition)
        driver = prepared.sha256 or prepared.driver.fingerprint()
        if (again := kept(found, folder, driver)) is not None:
            return again
        episodes = driven_episodes(found)
        keep(found, episodes, folder, driver)
        return episodes

    def _scored(
        self,
        prepared: PreparedVariant,
        condition: Condition,
        episodes: tuple[Episode, ...] | None,
    ) -> DriveRecord:
        names = prepared.variant.name, condition.name
        if episodes is None:
            return DriveRecord(*names, reason=self._why_not(prepared))
        study, made_by = self.study, dict[str, object]()
        job = None if study.elsewhere else self.job(prepared, condition)
        if job is not None:
            made_by = fingerprint(job, study.routes, study.set_size)
        record = DriveRecord.of(*names, made_by, episodes)
        # a drive without its frames; another evaluator keeps its own
        if job is not None:
            record.save(self.workspace.record(prepared.variant, condition))
        scores = score(episodes, study.set_size or len(episodes), study.seed)
        return replace(record, scores=scores)

    def _compared(
        self,
        prepared: PreparedVariant,
        condition: Condition,
        reference: DriveRecord,
        their_episodes: tuple[Episode, ...] | None,
    ) -> DriveRecord:
        episodes = self._episodes(prepared, condition)
        record = self._scored(prepared, condition, episodes)
        if episodes is None or their_episodes is None:
            return record
        return replace(
            record,
            difference=difference(record.routes, reference.routes, self.study.seed),
            apart=apart(episodes, their_episodes),
        )

    def _teller(self, stage: str) -> Callable[[DrivingProgress], None]:
        def tell(now: DrivingProgress) -> None:
            words = ""
            if now.driving_score is not None:
                words = f"DS {now.driving_score:.1f}  SR {now.success_rate:.1f} %"
            self.listener.on_progress(stage, now.done, now.total, words)

        return tell
