from pathlib import Path

import pytest
import torch
from torch import nn

from models.driver.network.stack import Highway, write_onnx


@pytest.fixture(scope="package")
def model() -> Highway:
    torch.manual_seed(3)
    model = Highway().eval()
    model.planner.anchors.copy_(torch.rand_like(model.planner.anchors) * 20)
    # an untrained model is undecided: let no rounding decide for it
    for head, gain in ((model.planner.score[-1], 100), (model.track.heat[-1], 5)):
        assert isinstance(head, nn.Linear | nn.Conv2d)
        head.weight.data *= gain
    return model


@pytest.fixture(scope="package")
def exported(model: Highway, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_onnx(model, tmp_path_factory.mktemp("highway") / "highway.onnx")
