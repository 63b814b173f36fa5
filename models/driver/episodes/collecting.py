"""Collects episodes: drives the routes of a collection, several at a time."""

import io
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np

from me2e_compress.base.atomic import write_bytes
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.graph import sha256_of
from me2e_compress.metrics.episode import Ending
from me2e_compress.simulator.camera_rig import CameraRig
from models.driver.episodes.collection import (
    FORMAT,
    MANIFEST,
    Collection,
    Task,
    tasks_of,
)
from models.driver.episodes.episode_arrays import Arrays, arrays_of
from models.driver.episodes.recording_policy import RecordingPolicy
from models.driver.errors import TrainingError
from models.driver.options import claim
from models.processes import process_pool

SUFFIX, SKIPPED = ".npz", ".skipped"
SHORTEST_US = 2_000_000
"""An episode that ends earlier is not kept."""


def collect(
    folder: Path,
    what: Collection,
    student: Path | None,
    workers: int,
    on_done: Callable[[int, int], None],
) -> None:
    """Drive what is missing of a collection, one file a route.

    The same collection gives the same bytes, whatever the number of workers and
    however often it was interrupted. An episode under 2 s leaves only a marker.

    Args:
        folder: Where the episodes go; `Collection` beside them as ``dataset.json``.
        what: What to collect.
        student: ONNX file of the student; None without one.
        workers: Processes; 1 stays in this one.
        on_done: Called with the routes done and their total, those of earlier runs
            included, at the start and after every route.

    Raises:
        TrainingError: The folder is of another collection, a route is one of those
            that ship, the student is not the collection's or fails, or a process was
            killed.
    """
    if workers < 1:
        raise TrainingError(f"collect: {workers} workers: at least one is needed")
    _check_student(what, student)
    tasks = tasks_of(what)
    claim(folder / MANIFEST, "collection", {"format": FORMAT, **asdict(what)})
    missing = [task for task in tasks if not _is_done(folder, task)]
    done = len(tasks) - len(missing)
    on_done(done, len(tasks))
    for _ in _driven(folder, what, student, missing, workers):
        done += 1
        on_done(done, len(tasks))


def _check_student(what: Collection, student: Path | None) -> None:
    if student is None:
        if what.student is not None:
            raise TrainingError(
                f"collect: the collection's student is {what.student}, none was given"
            )
        return
    policy, found = OnnxPolicy.open(student), sha256_of(student)
    if found != what.student:
        raise TrainingError(
            f"student {student}: its sha256 is {found}, the collection's {what.student}"
        )
    if policy.needs_images and policy.image_size != what.image_size:
        raise TrainingError(
            f"student {student}: takes images of {policy.image_size}, the "
            f"collection's are {what.image_size}"
        )


def _is_done(folder: Path, task: Task) -> bool:
    return any((folder / (task.name + end)).exists() for end in (SUFFIX, SKIPPED))


def _driven(
    folder: Path,
    what: Collection,
    student: Path | None,
    tasks: Iterable[Task],
    workers: int,
) -> Iterator[None]:
    """Yield after every route."""
    if workers == 1:
        for task in tasks:
            _collect_one(folder, what, student, task)
            yield
        return
    try:
        with process_pool(workers) as processes:
            jobs = [
                processes.submit(_collect_one, folder, what, student, task)
                for task in tasks
            ]
            for job in as_completed(jobs):
                job.result()
                yield
    except BrokenProcessPool as error:
        raise TrainingError(
            f"{folder}: a process was killed (out of memory?)"
        ) from error


def _collect_one(
    folder: Path, what: Collection, student: Path | None, task: Task
) -> None:
    """Drive a route and write its file."""
    arrays = episode_of(what, task, None if student is None else _opened(student))
    try:
        if arrays is None:
            write_bytes(folder / (task.name + SKIPPED), b"under 2 s\n")
        else:
            content = io.BytesIO()
            np.savez(content, allow_pickle=False, **arrays)
            write_bytes(folder / (task.name + SUFFIX), content.getvalue())
    except OSError as error:
        raise TrainingError(f"{folder}: cannot be written: {error.strerror}") from error


@lru_cache(maxsize=1)
def _opened(student: Path) -> OnnxPolicy:
    return OnnxPolicy.open(student)


def episode_of(
    what: Collection, task: Task, student: OnnxPolicy | None
) -> Arrays | None:
    """Drive one route of a collection; None if it ended too early.

    Raises:
        TrainingError: The student failed.
    """
    recording = RecordingPolicy(
        what.seed,
        what.noise,
        what.expert_share,
        student,
        what.every,
        CameraRig(*what.image_size),
    )
    route = task.route()
    episode = drive(route, recording, Drive())
    if episode.ending is Ending.POLICY_FAILED or recording.world is None:
        raise TrainingError(f"route {task.name}: {episode.failure}")
    frames, world = recording.frames, recording.world
    if len(frames) * world.dt_us < SHORTEST_US:
        return None
    arrays = arrays_of(world, recording.top, frames, what.every, what.image_size)
    return arrays | {
        "crashed": np.array(episode.ending is Ending.COLLISION),
        "scenario": np.array(task.scenario),
        "route": np.array(task.name),
    }
