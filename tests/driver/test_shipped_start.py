"""The checkpoint that ships is the driver that ships, and can be gone on from."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from driver.checkpoint import Start, TrainingCheckpoint
from driver.course import load
from driver.data import Sequences
from driver.losses import LampHead
from driver.network.config import HighwayConfig
from driver.network.stack import Highway
from driver.process import StageTask, Training, TrainingProcess
from driver.process_group import ProcessGroup
from me2e_compress.errors import TrainingError
from me2e_compress.zoo.shipped import SHIPPED, checkpoint, shipped
from tests.driver.made import LITTLE, arrays_of, write

TRAINED = Path(__file__).parents[2] / "benchmarks/road_2/training"
LAST = TRAINED / "seed-1/round-2/training-1/last.pt"
ONE_STEP = Training(
    steps=1, batch=1, workers=1, check_count=1, sequences=Sequences(length=2)
)


@pytest.mark.parametrize("name", SHIPPED)
def test_its_weights_are_those_of_the_onnx_file(name: str) -> None:
    graph = onnx.load(shipped(name)).graph
    start = LAST if name == "highway-2" else checkpoint(name)
    mean = load(start, HighwayConfig()).state_dict()
    other = [
        tensor.name
        for tensor in graph.initializer
        if not np.array_equal(numpy_helper.to_array(tensor), mean[tensor.name].numpy())
    ]
    assert len(graph.initializer) > 400
    assert other == []


def test_a_step_goes_on_from_it(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{i}.npz", arrays_of(5, i)) for i in range(2)]
    config, start = HighwayConfig(), checkpoint("highway")
    task = StageTask(
        ONE_STEP, config, (files[0],), (files[1],), start, tmp_path / "training"
    )
    task.folder.mkdir()
    TrainingProcess(0, ProcessGroup.of(1, config), task).run()
    before, after = Start.load(start), TrainingCheckpoint.load(task.folder / "last.pt")
    gaps = [
        (after.model[name] - value).abs().max()
        for name, value in before.mean.items()
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


def test_the_shipped_one_is_not_resumed() -> None:
    with pytest.raises(TrainingError, match="it lacks 'model'"):
        TrainingCheckpoint.load(checkpoint("highway"))
