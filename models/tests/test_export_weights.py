"""Exports of a checkpoint: what is refused, what the file says, what it answers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from me2e_compress.base.errors import GraphError, RecipeError
from models import export as exporting
from models.export import ExportOptions, build, export_stack
from models.published_names import PUBLISHED
from models.stacks import VAD_TINY, Stack
from models.synthetic_frames import frames
from models.tests.published_files import mmcv, parallel, saved, thin
from models.tests.published_layouts import published
from models.vad.stack import VadTiny


def test_nothing_is_written_of_what_does_not_fit(tmp_path: Path) -> None:
    tensors = thin(published("tcp"))
    del tensors["merge.2.bias"]
    path = saved(tmp_path / "a.pth", tensors)
    with pytest.raises(GraphError, match="names missing"):
        export_stack("tcp", tmp_path / "out.onnx", ExportOptions(weights=path))
    assert not (tmp_path / "out.onnx").exists()


def test_a_checkpoint_is_not_overwritten(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.pth", thin(published("tcp")))
    with pytest.raises(GraphError, match=r"a\.pth"):
        export_stack("tcp", path, ExportOptions(weights=path, force=True))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seed": 0, "weights": Path("a.pth")}, "--seed draws weights, --weights bri"),
        ({"ema": True}, "--ema needs --weights"),
    ],
)
def test_options_that_contradict_the_weights(
    options: dict[str, Any], words: str
) -> None:
    with pytest.raises(RecipeError, match=words):
        ExportOptions(**options)


@pytest.mark.parametrize("dialect", [None, "me2e"])
def test_an_export_is_of_the_checkpoint_and_names_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    dialect: str | None,
) -> None:
    """As far as the trace, which takes minutes at full size."""
    path = saved(tmp_path / "a.pth", mmcv(thin(published("vad-tiny"))))
    traced: list[torch.nn.Module] = []

    def trace(spec: Stack, model: torch.nn.Module, opset: int) -> onnx.ModelProto:
        traced.append(model)
        return onnx.parser.parse_model(
            '<ir_version: 8, opset_import: ["" : 17]>'
            "m (float[1] img) => (float[1] plan) { plan = Relu(img) }"
        )

    monkeypatch.setattr(exporting, "trace", trace)
    options = ExportOptions(weights=path, dialect=dialect)
    file = tmp_path / "out.onnx"
    lines = export_stack("vad-tiny", file, options)

    (model,) = traced
    assert all(bool((each == 0.5).all()) for each in model.parameters())
    entries = onnx.load(file).metadata_props
    said = {entry.key: entry.value for entry in entries}
    assert json.loads(said["me2e.weights"])["epoch"] == 60
    assert lines[1].startswith("weights: a.pth, epoch 60, ")
    assert "NVIDIA's DL4AGX" in lines[-1]
    assert "models/README.md" in lines[-1]


@pytest.mark.slow
def test_vad_of_a_checkpoint_answers_as_in_torch(tmp_path: Path) -> None:
    """Names that the original has otherwise, at full size: the plan reads them all."""
    drawn = build("vad-tiny", seed=3)
    assert isinstance(drawn, VadTiny)
    names = PUBLISHED["vad-tiny"]
    state = {names.published(name): each for name, each in drawn.state_dict().items()}
    path = saved(tmp_path / "vad.pth", mmcv(parallel(state)))
    file = tmp_path / "vad.onnx"
    export_stack("vad-tiny", file, ExportOptions(weights=path))

    (frame,) = frames(VAD_TINY, 1, seed=7)
    feed = {**frame, "prev_bev": np.zeros(VAD_TINY.inputs["prev_bev"], np.float32)}
    session = onnxruntime.InferenceSession(file)
    wanted = drawn(*(torch.from_numpy(feed[name]) for name in VAD_TINY.inputs))
    for got, want in zip(session.run(None, feed), wanted, strict=True):
        assert np.abs(got - want.numpy()).max() <= 1e-4 * want.abs().max()
