"""Training in several processes that average their gradients; resumes after a kill."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from torch.multiprocessing.spawn import ProcessException, spawn

from me2e_compress.runtime.children import end_with_parent, sheltered
from models.driver.checkpoint import TrainingCheckpoint
from models.driver.errors import TrainingError
from models.driver.network.config import HighwayConfig
from models.driver.options import difference
from models.driver.process import (
    CHECKPOINT,
    INPUTS,
    StageTask,
    Training,
    TrainingProcess,
)
from models.driver.process_group import ProcessGroup
from models.processes import kill_on_error

__all__ = ["Training", "train"]

POLL_S = 0.5
"""Between two checks of how far the processes are."""
MAY_CHANGE = ("steps", "save_every", "check_every", "check_count")
"""Options of a stage that may change when it resumes."""


def train(
    what: Training,
    config: HighwayConfig,
    files: Sequence[Path],
    held_out: Sequence[Path],
    start: Path | None,
    folder: Path,
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Run a stage, or what is left of it.

    The same arguments give the same weights, however often it was interrupted; another
    number of workers draws other batches.

    Args:
        what: the stage.
        config: sizes of the model.
        files: episodes to learn from; what is named twice is drawn twice as often.
        held_out: episodes for validation only.
        start: checkpoint to begin with; None begins with random weights.
        folder: gets ``last.pt`` and ``log.jsonl``.
        on_step: called from time to time with the steps done and their total.

    Returns:
        The checkpoint.

    Raises:
        TrainingError: fewer episodes than processes, a file is not what it should be,
            another stage was begun in the folder, or a process died.
    """
    if len(set(files)) < what.workers or not held_out:
        raise TrainingError(
            f"{len(set(files))} episodes and {len(held_out)} held out are too few for "
            f"{what.workers} processes"
        )
    folder.mkdir(parents=True, exist_ok=True)
    last = folder / CHECKPOINT
    if not last.exists() or _steps(last, what) < what.steps:
        _run(
            StageTask(what, config, tuple(files), tuple(held_out), start, folder),
            on_step,
        )
    shutil.rmtree(folder / INPUTS, ignore_errors=True)
    return last


def _run(task: StageTask, on_step: Callable[[int, int], None]) -> None:
    """Run the processes of a stage to its end.

    Raises:
        TrainingError: one of them died.
    """
    what, folder = task.what, task.folder
    group = ProcessGroup.of(what.workers, task.config)
    try:
        with kill_on_error():
            with sheltered():
                running = spawn(_process, (task, group), what.workers, join=False)
            while running is not None and not running.join(POLL_S):
                on_step(group.steps_done(), what.steps)
    except ProcessException as error:
        raise TrainingError(f"{folder}: training failed: {_cause(error)}") from error
    on_step(what.steps, what.steps)


def _process(rank: int, task: StageTask, group: ProcessGroup) -> None:
    end_with_parent()
    torch.set_num_threads(1)
    TrainingProcess(rank, group, task).run()


def _cause(error: ProcessException) -> str:
    """Return the last line of a process's traceback, without our errors' names."""
    last = str(error).strip().splitlines()[-1]
    kind, _, words = last.partition(": ")
    return (
        words
        if kind.startswith(("me2e_compress.base.errors.", "models.driver.errors."))
        else last
    )


def _steps(checkpoint: Path, what: Training) -> int:
    """Return how many steps a checkpoint of this stage has taken.

    Raises:
        TrainingError: it is not one, or of another stage.
    """
    found = TrainingCheckpoint.load(checkpoint)
    words = difference(json.loads(found.what), asdict(what), MAY_CHANGE)
    if words is not None:
        raise TrainingError(
            f"{checkpoint}: of another stage: its {words[0]} is {words[1]}, this "
            f"one's {words[2]}"
        )
    return found.step
