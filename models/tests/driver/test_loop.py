"""A stage of training: what it needs, how it goes on, what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models.driver.checkpoint import TrainingCheckpoint
from models.driver.data import Sequences
from models.driver.errors import TrainingError
from models.driver.log import Log
from models.driver.loop import train
from models.driver.losses import LampHead
from models.driver.network.stack import Highway
from models.driver.process import StageTask, Training, TrainingProcess, rate_at
from models.driver.process_group import ProcessGroup
from models.driver.sampled_losses import SampledLosses
from models.tests.driver.made import LITTLE, arrays_of, write

WHAT = Training(
    steps=4,
    batch=1,
    workers=1,
    save_every=2,
    check_every=2,
    check_count=1,
    sequences=Sequences(length=2),
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    folder = tmp_path_factory.mktemp("episodes")
    return tuple(write(folder / f"{i}.npz", arrays_of(5, i)) for i in range(3))


def stage(task: StageTask) -> TrainingProcess:
    """All of a stage in this process."""
    return TrainingProcess(0, ProcessGroup.of(1, task.config), task)


@pytest.fixture
def task(files: tuple[Path, ...], tmp_path: Path) -> StageTask:
    return StageTask(WHAT, LITTLE, files[1:], files[:1], None, tmp_path)


def weights(folder: Path) -> dict[str, bytes]:
    found = TrainingCheckpoint.load(folder / "last.pt")
    return {
        f"{kind}.{name}": value.contiguous().numpy().tobytes()
        for kind, state in (("model", found.model), ("mean", found.mean))
        for name, value in state.items()
    }


class Killed:
    """Losses that end with the process, in its fourth step."""

    def __init__(self, sampled: SampledLosses) -> None:
        self.sampled, self.asked = sampled, 0

    def draw(
        self, model: Highway, lamps: LampHead, rng: np.random.Generator
    ) -> dict[str, torch.Tensor]:
        self.asked += 1
        if self.asked == 4:
            raise KeyboardInterrupt
        return self.sampled.draw(model, lamps, rng)


@pytest.mark.parametrize("modules", [(), ("planner",)])
def test_an_interrupted_stage_comes_to_the_same_weights(
    task: StageTask, tmp_path: Path, modules: tuple[str, ...]
) -> None:
    how = replace(WHAT.augmentation, overlooked=0.3)
    task = replace(task, what=replace(WHAT, modules=modules, augmentation=how))
    whole = replace(task, folder=tmp_path / "whole")
    broken = replace(task, folder=tmp_path / "broken")
    for each in (whole, broken):
        each.folder.mkdir()
    stage(whole).run()

    first = stage(broken)
    first.sampled = Killed(first.sampled)  # type: ignore[assignment]
    with pytest.raises(KeyboardInterrupt):
        first.run()
    assert TrainingCheckpoint.load(broken.folder / "last.pt").step == 2
    stage(broken).run()

    assert weights(broken.folder) == weights(whole.folder)


def test_the_log_tells_losses_of_samples_nobody_learned_from(task: StageTask) -> None:
    stage(task).run()
    rows = Log(task.folder / "log.jsonl").rows()
    assert [(row["what"], row["step"]) for row in rows] == [
        ("losses", 2),
        ("losses", 4),
    ]
    assert rows[1]["held_out"]["plan_m"] > 0
    assert rows[1]["seconds"] >= rows[0]["seconds"] > 0


def test_a_stage_that_goes_on_tells_its_steps_once(task: StageTask) -> None:
    stage(replace(task, what=replace(WHAT, steps=2))).run()
    stage(task).run()
    steps = [row["step"] for row in Log(task.folder / "log.jsonl").rows()]
    assert steps == [2, 4]


def test_the_planner_alone_changes_nothing_else(
    task: StageTask, tmp_path: Path
) -> None:
    stage(task).run()
    inner = tmp_path / "planner"
    inner.mkdir()
    alone = replace(WHAT, steps=2, modules=("planner",))
    start = tmp_path / "last.pt"
    stage(replace(task, what=alone, start=start, folder=inner)).run()
    before = {
        name: value.contiguous().numpy().tobytes()
        for name, value in TrainingCheckpoint.load(start).mean.items()
    }
    after = weights(inner)
    learned = {
        name.split(".")[0] for name in before if before[name] != after[f"model.{name}"]
    }
    assert learned == {"planner"}


def test_a_stage_begins_with_the_mean_of_the_one_before(
    task: StageTask, tmp_path: Path
) -> None:
    stage(task).run()
    begun = stage(replace(task, start=task.folder / "last.pt", folder=tmp_path / "b"))
    mean = TrainingCheckpoint.load(task.folder / "last.pt").mean
    found = begun.model.state_dict()
    assert all(torch.equal(found[name], mean[name]) for name in mean)


def test_anchors_are_drawn_from_the_episodes(task: StageTask) -> None:
    anchors = stage(task).model.planner.anchors
    assert anchors.abs().max() < 1e-4  # the expert of these goes on as now


def test_the_rate_warms_up_and_falls() -> None:
    what = replace(WHAT, steps=1000, rate=1.0)
    rates = [rate_at(what, step) for step in (0, 99, 500, 999)]
    assert rates == pytest.approx([0.01, 0.986, 0.51, 0.01], abs=0.002)


def test_a_stage_of_something_else_is_not_gone_on_with(
    task: StageTask, files: tuple[Path, ...]
) -> None:
    stage(replace(task, what=replace(WHAT, steps=2))).run()
    other = replace(WHAT, rate=3e-3)
    words = r"last\.pt: of another stage: its rate is 0\.0015, this one's 0\.003"
    with pytest.raises(TrainingError, match=words):
        train(other, LITTLE, files[1:], files[:1], None, task.folder)


def test_a_finished_stage_is_not_begun_again(
    task: StageTask, files: tuple[Path, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage(task).run()
    (inputs := task.folder / "planner-inputs").mkdir()
    monkeypatch.setattr(ProcessGroup, "of", None)  # nobody is started
    found = train(WHAT, LITTLE, files[1:], files[:1], None, task.folder)
    assert found == task.folder / "last.pt"
    assert not inputs.exists()


def test_a_start_of_another_model_is_refused(task: StageTask, tmp_path: Path) -> None:
    wider = Highway(replace(LITTLE, stages=(8, 8, 8, 16)))
    state = LampHead(64).state_dict()
    start = tmp_path / "wider.pt"
    TrainingCheckpoint(wider.state_dict(), wider.state_dict(), state, {}, 1, "{}").save(
        start
    )
    with pytest.raises(TrainingError, match=r"wider\.pt: a checkpoint of another mod"):
        stage(replace(task, start=start))


@pytest.mark.parametrize(("learn", "look"), [(1, 1), (2, 0)])
def test_too_few_episodes_are_an_error(
    files: tuple[Path, ...], tmp_path: Path, learn: int, look: int
) -> None:
    what = replace(WHAT, workers=2)
    with pytest.raises(TrainingError, match=f"{learn} episodes and {look} held out"):
        train(what, LITTLE, files[:learn], files[:look], None, tmp_path)


def test_what_a_process_dies_of_is_told_in_one_line(
    files: tuple[Path, ...], tmp_path: Path
) -> None:
    odd = write(tmp_path / "odd.npz", arrays_of(2, size=(48, 80)))
    what = replace(WHAT, workers=2)
    words = r"training failed: \S+odd\.npz: its cameras have 48 x 80 pixels, the model "
    with pytest.raises(TrainingError, match=words + "sees 96 x 160") as caught:
        train(what, LITTLE, (files[1], odd), files[:1], None, tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_a_checkpoint_says_what_trained_it(task: StageTask) -> None:
    stage(replace(task, what=replace(WHAT, steps=2))).run()
    told = json.loads(TrainingCheckpoint.load(task.folder / "last.pt").what)
    assert (told["steps"], told["augmentation"]["hints"]) == (2, 0.7)
    assert told["augmentation"]["overlooked"] == WHAT.augmentation.overlooked
