"""Checkpoints: whole, of the right model, or an error of one line."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from models.driver.checkpoint import TrainingCheckpoint, fit
from models.driver.course import load
from models.driver.errors import TrainingError
from models.driver.network.stack import Highway
from models.tests.driver.made import LITTLE


def checkpoint(module: nn.Module, step: int = 3) -> TrainingCheckpoint:
    state = module.state_dict()
    return TrainingCheckpoint(
        state, state, {"a": torch.ones(2)}, {"lr": 0.1}, step, "{}"
    )


def test_what_is_saved_is_what_is_loaded(tmp_path: Path) -> None:
    saved = checkpoint(nn.Linear(2, 3))
    saved.save(tmp_path / "last.pt")
    found = TrainingCheckpoint.load(tmp_path / "last.pt")
    assert torch.equal(found.model["weight"], saved.model["weight"])
    assert (found.step, found.optimizer, found.what) == (3, {"lr": 0.1}, "{}")


def test_strides_are_kept(tmp_path: Path) -> None:
    layer = nn.Conv2d(4, 4, 3)
    layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)
    checkpoint(layer).save(tmp_path / "last.pt")
    found = TrainingCheckpoint.load(tmp_path / "last.pt")
    assert found.model["weight"].stride() == layer.weight.stride()


def test_saving_replaces_in_one_step(tmp_path: Path) -> None:
    for step in (1, 2):
        checkpoint(nn.Linear(2, 3), step).save(tmp_path / "last.pt")
    assert [file.name for file in tmp_path.iterdir()] == ["last.pt"]
    assert TrainingCheckpoint.load(tmp_path / "last.pt").step == 2


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"gone/last\.pt: cannot be written: "):
        checkpoint(nn.Linear(2, 3)).save(tmp_path / "gone" / "last.pt")


@pytest.mark.parametrize("left", [None, 0, 16, 3000])
def test_a_file_that_is_none_or_half_of_one_is_named(
    tmp_path: Path, left: int | None
) -> None:
    checkpoint(nn.Linear(20, 30)).save(tmp_path / "last.pt")
    content = (tmp_path / "last.pt").read_bytes()[:left]
    (tmp_path / "last.pt").unlink()
    if left is not None:
        (tmp_path / "last.pt").write_bytes(content)
    with pytest.raises(TrainingError, match=r"last\.pt: not a checkpoint: ") as caught:
        TrainingCheckpoint.load(tmp_path / "last.pt")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [{"model": {}}, [1, 2], torch.zeros(3)])
def test_weights_of_something_else(tmp_path: Path, content: object) -> None:
    torch.save(content, tmp_path / "last.pt")
    with pytest.raises(TrainingError, match="not a checkpoint of training: it lacks"):
        TrainingCheckpoint.load(tmp_path / "last.pt")


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    torch.save(Path("harmful"), tmp_path / "last.pt")
    with pytest.raises(TrainingError, match="not a checkpoint: Weights only load"):
        TrainingCheckpoint.load(tmp_path / "last.pt")


def test_a_checkpoint_of_another_model_names_the_difference(tmp_path: Path) -> None:
    path = tmp_path / "last.pt"
    checkpoint(Highway(LITTLE)).save(path)
    other = replace(LITTLE, stages=(8, 8, 8, 16))
    words = r"last\.pt: a checkpoint of another model: backbone\.\S+ is \[8.*\] in it, "
    with pytest.raises(TrainingError, match=words + r"\[16.*\] in this one"):
        load(path, other)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"weight": torch.zeros(3, 2)}, r"bias is missing in it, \[3\] in this"),
        ({**nn.Linear(2, 3).state_dict(), "more": torch.zeros(1)},
         r"more is \[1\] in it, missing in this"),
    ],
)  # fmt: skip
def test_weights_that_are_missing_or_too_many_are_named(
    state: dict[str, torch.Tensor], words: str
) -> None:
    with pytest.raises(TrainingError, match=words):
        fit(nn.Linear(2, 3), state, Path("a.pt"))


def test_the_driver_has_the_averaged_weights(tmp_path: Path) -> None:
    model, mean = Highway(LITTLE), Highway(LITTLE)
    saved = replace(checkpoint(model), mean=mean.state_dict())
    saved.save(tmp_path / "last.pt")
    driver = load(tmp_path / "last.pt", LITTLE)
    assert torch.equal(driver.planner.cells, mean.planner.cells)
    assert not driver.training
