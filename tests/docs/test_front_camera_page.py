"""docs/front-camera.md, in short: recorded, cloned, checked, asked for a plan."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import onnx
import pytest

from me2e_compress import CalibrationSet, FramesOptions, check_model, record_frames
from me2e_compress.runtime.session import Session
from tests.docs.pages import ROOT, blocks

PAGE = ROOT / "docs" / "front-camera.md"
HOME = ROOT / "examples" / "front_camera"


@pytest.fixture(scope="module")
def clone() -> ModuleType:
    spec = importlib.util.spec_from_file_location("front_camera", HOME / "clone.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_is_recorded_cloned_and_plans(clone: ModuleType, tmp_path: Path) -> None:
    blank, model = tmp_path / "blank.onnx", tmp_path / "front.onnx"
    onnx.save(clone.network(None), blank)
    options = FramesOptions(6, scene_length=6, adapter=HOME / "front.toml")
    frames = record_frames(blank, tmp_path / "frames", options)

    xs, ways = clone.examples(frames)
    weights = clone.fitted(xs, ways)
    onnx.save(clone.network(weights), model)

    assert ways.shape == (2, 4, 2)
    assert (np.diff(ways[:, :, 0]) >= 0).all()
    assert check_model(model, HOME / "front.toml").fits
    first = next(iter(CalibrationSet(frames))).arrays
    del first["can_bus"]
    (planned,) = Session(model, threads=1).run(first).values()
    assert planned.reshape(-1) == pytest.approx(xs[0] @ weights, abs=1e-3)


def test_every_command_of_the_page_names_what_is_there() -> None:
    (shown,) = blocks(PAGE, "sh")

    for name in ("clone.py", "front.toml"):
        assert name in shown.text
        assert (HOME / name).is_file()
