"""VAD-tiny as it is exported, and what its trace knows of it."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.graph.modules.assign import Assignment, assign
from me2e_compress.graph.modules.module_map import ModuleMap
from models.tests import truth
from models.vad.stack import VadTiny


@dataclasses.dataclass(frozen=True)
class Reference:
    """A stack, read back.

    Attributes:
        model: the exported graph.
        placed: what the map makes of it.
        truth: what the trace knew.
        parameters: elements of each parameter.
        state_dict: elements of each parameter and persistent buffer.
    """

    model: ir.Model
    placed: Assignment
    truth: truth.Truth
    parameters: Mapping[str, int]
    state_dict: Mapping[str, int]


@pytest.fixture(scope="session")
def vad(vad_tiny: Path, vad_torch: VadTiny, vad_truth: truth.Truth) -> Reference:
    """VAD-tiny with nuScenes heads, seed 0, opset 17."""
    model = graph.load(vad_tiny)
    return Reference(
        model,
        assign(model, ModuleMap.load("vad")),
        vad_truth,
        {name: tensor.numel() for name, tensor in vad_torch.named_parameters()},
        {name: tensor.numel() for name, tensor in vad_torch.state_dict().items()},
    )
