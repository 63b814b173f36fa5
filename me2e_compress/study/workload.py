"""Remaining drives of a study, and an estimate of their duration."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from me2e_compress.base.display import format_duration, plural, table
from me2e_compress.commands.result import Result, View
from me2e_compress.driving.latency import DecisionFacts
from me2e_compress.driving.realtime import LatencyModel, skipped_decisions
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study
from me2e_compress.study.workspace import Workspace

# CPU seconds of a frame of the world, and of a decision: six pictures and one inference
# of the driver that ships on one core of a Xeon (two routes, at every frame and at
# every eighth)
FRAME_S, DECISION_S = 0.0024, 0.021


@dataclass(frozen=True)
class PlannedDrive:
    """Remaining work of one drive; ``hours`` are for all workers together."""

    variant: str
    condition: str
    done: int
    routes: int
    hours: float


@dataclass(frozen=True, repr=False)
class Workload(Result):
    """Remaining work of a study, by an estimate of the hours."""

    title: str
    drives: tuple[PlannedDrive, ...]
    set_size: int
    workers: int

    def view(self) -> View:
        """Return numbers of drives and routes, the time left, and a row per drive."""
        headline = f"{self.title}: {plural(len(self.drives), 'drive')}"
        if self.set_size:
            routes = sum(drive.routes for drive in self.drives)
            done = sum(drive.done for drive in self.drives)
            left = format_duration(3600 * sum(drive.hours for drive in self.drives))
            headline += (
                f", {plural(routes, 'route')}, {done:,} of them driven; about"
                f" {left} on {plural(self.workers, 'worker')} (an estimate)"
            )
        else:
            headline += ", of routes that the evaluator knows"
        columns, rows = ("variant", "condition", "routes driven", "time left"), []
        for drive in self.drives:
            driven = f"{drive.done} of {drive.routes}"
            hours = format_duration(3600 * drive.hours)
            rows.append((drive.variant, drive.condition, driven, hours))
        return View(headline, [table("Drives", columns, rows, words=2)])


def workload(study: Study, folder: str | Path, workers: int = 1) -> Workload:
    """Count the missing routes, and estimate the hours."""
    place, total = Workspace(Path(folder)), len(study.routes)
    drives = list[PlannedDrive]()
    for condition in study.conditions:
        period = frames_per_decision(study, condition)
        for variant in study.driven_under(condition):
            # Frames and decisions of the missing routes
            name = place.drive(variant, condition)
            finished = place.folder / "results" / name / "routes"
            recorded = place.record(variant, condition).is_file()
            left_s = [
                study.driven_by.expected_s(route)
                for route in study.routes
                if not recorded and not (finished / f"{route.id}.json").is_file()
            ]
            frames = 1e6 * sum(left_s) / condition.drive.dt_us
            hours = frames * (FRAME_S + DECISION_S / period) / 3600 / workers
            counts = total - len(left_s), total
            drives.append(PlannedDrive(variant.name, condition.name, *counts, hours))
    return Workload(study.title, tuple(drives), study.set_size, workers)


def frames_per_decision(study: Study, condition: Condition) -> int:
    """Return the number of frames that a decision is in force: n + 1 of equation 4.

    Frames are the condition's steps. For a trace, or a mean of one, it is based on the
    baseline's median on the device, if the study states it, with no road users in view.
    """
    if condition.drive.latency_model is LatencyModel.FIFO:
        return 1
    if condition.mean_of:
        return frames_per_decision(study, study.drive_of(condition.mean_of)[1])
    latency_us = round(1e6 * (study.timing.baseline_median_s or 0.0))
    source = condition.source(study.seed).with_trace((latency_us,), 1.0)
    nobody = DecisionFacts(latency_us, np.empty((0, 2)))
    latency_us = source.on_route("")(nobody)
    return skipped_decisions(latency_us, condition.drive.dt_us) + 1
