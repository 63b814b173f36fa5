"""The original's forms of VAD-tiny compute what those of models/ do."""

import torch

from benchmarks.original_patterns import FORMS, restored
from models.tests.vad.sizes import SIZES
from models.vad.stack import VadTiny


def test_the_forms_of_the_original_compute_the_same() -> None:
    size = SIZES["small"]
    draws = torch.Generator().manual_seed(0)
    model = VadTiny("nuscenes", "operator", size.config).requires_grad_(False).eval()
    for weight in model.parameters():
        weight.normal_(0.0, 0.1, generator=draws)
    img, lidar2img, can_bus, bev = (
        torch.randn(shape, generator=draws) for shape in size.stack.inputs.values()
    )
    lidar2img = torch.eye(4) + lidar2img / 10  # some pillars are seen
    inputs = img, lidar2img, can_bus, bev
    with torch.no_grad():
        wanted = model(*inputs)
        found = restored(model)(*inputs)
    assert set(map(type, model.modules())) >= set(FORMS.values())
    for name, one, two in zip(size.stack.outputs, wanted, found, strict=True):
        assert (one - two).abs().max() < 1e-4 * one.abs().max(), name
