"""Logits that go through their parts of a range and back, in onnxruntime."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from models.bev.decoder import inverse_sigmoid, precise_sigmoid

pytestmark = pytest.mark.xdist_group("uniad")

LIMIT = np.log(1e-5)
"""What the inverse sigmoid returns at its end."""


class ThereAndBack(nn.Module):
    def forward(self, logits: Tensor) -> Tensor:
        return inverse_sigmoid(precise_sigmoid(logits))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_logit_comes_back_wherever_it_is(tmp_path: Path) -> None:
    logits = np.random.default_rng().uniform(-30, 11, 1000).astype(np.float32)
    file = tmp_path / "m.onnx"
    torch.onnx.export(
        ThereAndBack(),
        (torch.from_numpy(logits),),
        file,
        input_names=["logits"],
        opset_version=17,
        dynamo=False,
    )
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])

    (found,) = session.run(None, {"logits": logits})

    # beside 1 a part has 24 bits: a logit of 11 then has 6e-8 / 1.7e-5
    tolerance = np.where(logits > 0, 5e-3, 1e-5)
    assert np.all(np.abs(found - np.maximum(logits, LIMIT)) <= tolerance)
