"""The trained driver as one ONNX file."""

from pathlib import Path

import torch

from driver.network.stack import Highway
from me2e_compress.zoo.export import save, trace
from me2e_compress.zoo.stacks import find

OPSET = 17
"""LayerNormalization is one operator from here on."""


def write(model: Highway, path: Path) -> Path:
    """Write a model in evaluation mode, standard operators only, nothing folded.

    Args:
        model: the stack, its weights as they are to drive.
        path: the ``.onnx``; replaced in one step.

    Raises:
        GraphError: the exporter wrote another opset, or it cannot be written.
    """
    spec = find("highway")
    # torch's stubs leave this form of `to` out
    model.eval().to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    return save(trace(spec, model, OPSET), spec.metadata(), path)


def parameters(model: Highway) -> int:
    """Return how many parameters were trained."""
    return sum(p.numel() for p in model.parameters())
