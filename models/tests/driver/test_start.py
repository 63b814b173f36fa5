"""The driver that ships is this network, and training goes on from a checkpoint."""

import hashlib
from pathlib import Path

import onnx
import pytest
import torch
from onnx import numpy_helper

from me2e_compress.shipped.drivers import SHIPPED, card, shipped_model
from models.driver.checkpoint import Start, TrainingCheckpoint
from models.driver.data import Sequences
from models.driver.errors import TrainingError
from models.driver.losses import LampHead
from models.driver.network.config import HighwayConfig
from models.driver.network.stack import Highway, write_onnx
from models.driver.process import StageTask, Training, TrainingProcess
from models.driver.process_group import ProcessGroup
from models.tests.driver.made import LITTLE, arrays_of, write

NAME = SHIPPED[-1]
ONE_STEP = Training(
    steps=1, batch=1, workers=1, check_count=1, sequences=Sequences(length=2)
)


def test_the_network_with_its_weights_writes_the_bytes_that_ship(
    tmp_path: Path,
) -> None:
    weights = {
        tensor.name: torch.from_numpy(numpy_helper.to_array(tensor).copy())
        for tensor in onnx.load(shipped_model(NAME)).graph.initializer
    }
    model = Highway()
    unknown = model.load_state_dict(weights, strict=False).unexpected_keys
    file = write_onnx(model, tmp_path / "driver.onnx")
    assert (len(weights), unknown) == (454, [])
    assert hashlib.sha256(file.read_bytes()).hexdigest() == card(NAME).sha256


def test_a_step_goes_on_from_a_start(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{i}.npz", arrays_of(5, i)) for i in range(2)]
    config, start = HighwayConfig(), tmp_path / "start.pt"
    mean, lamps = Highway(config).state_dict(), LampHead(64).state_dict()
    torch.save({"mean": mean, "lamps": lamps}, start)
    task = StageTask(
        ONE_STEP, config, (files[0],), (files[1],), start, tmp_path / "training"
    )
    task.folder.mkdir()
    TrainingProcess(0, ProcessGroup.of(1, config), task).run()
    after = TrainingCheckpoint.load(task.folder / "last.pt")
    gaps = [
        (after.model[name] - value).abs().max()
        for name, value in mean.items()
        if value.is_floating_point() and "running" not in name
    ]
    assert after.step == 1
    assert 0 < max(gaps) < 1e-3  # one step of the warm-up, not other weights


def test_a_whole_checkpoint_is_a_start(tmp_path: Path) -> None:
    model, mean, lamps = Highway(LITTLE), Highway(LITTLE), LampHead(64)
    whole = TrainingCheckpoint(
        model.state_dict(), mean.state_dict(), lamps.state_dict(), {}, 1, "{}"
    )
    whole.save(tmp_path / "last.pt")
    found = Start.load(tmp_path / "last.pt")
    assert torch.equal(found.mean["planner.cells"], mean.planner.cells)
    assert found.lamps.keys() == lamps.state_dict().keys()


@pytest.mark.parametrize("lacking", ["mean", "lamps"])
def test_half_a_start_is_none(tmp_path: Path, lacking: str) -> None:
    content: dict[str, object] = {
        name: {} for name in ("mean", "lamps") if name != lacking
    }
    torch.save(content, tmp_path / "half.pt")
    with pytest.raises(TrainingError, match=rf"half\.pt: .* it lacks '{lacking}'"):
        Start.load(tmp_path / "half.pt")
