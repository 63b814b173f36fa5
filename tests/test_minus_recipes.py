"""The recipes that take one module from the driver, on a small one like it."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.errors import FramesError
from me2e_compress.graph import provenance
from me2e_compress.graph.modules import detect
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from me2e_compress.runtime.session import Session, replay
from tests.stand_in import record_driver, write_model

DROPPED = {
    "track": ("agents",),
    "map": ("lanes",),
    "motion": ("motions",),
    "occ": ("occupancy",),
}
SCHEMES = {
    "-".join(names): sum((DROPPED[name] for name in names), ())
    for names in (
        *(("map", "motion"), ("occ", "motion"), ("occ", "map")),
        ("occ", "map", "motion"),
    )
}
OUTPUTS = (
    *("plan", "agents", "lanes", "motions", "occupancy"),
    *("prev_bev_out", "prev_memory_out"),
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("driver") / "m.onnx")


def recording(folder: Path, count: int) -> CalibrationSet:
    return CalibrationSet(record_driver(folder, count))


def without(module: str, model: Path, frames: CalibrationSet) -> ir.Model:
    loaded = graph.load(model)
    context = Context(detect(loaded), frames)
    return PassManager(recipe.load(f"minus-{module}")).run(loaded, context).model


def plans(
    model: ir.Model | Path, frames: CalibrationSet
) -> list[npt.NDArray[np.float32]]:
    return [
        np.asarray(found["plan"], np.float32)
        for found in replay(Session(model), frames, ["plan"])
    ]


@pytest.mark.parametrize("module", DROPPED)
def test_the_module_is_gone_with_its_outputs(
    model: Path, tmp_path: Path, module: str
) -> None:
    made = without(module, model, recording(tmp_path / "f", 3))

    assert module not in {provenance.module_of(node) for node in made.graph}
    left = tuple(name for name in OUTPUTS if name not in DROPPED[module])
    assert tuple(value.name for value in made.graph.outputs) == left
    inputs, _ = graph.interface(made)
    assert inputs == graph.interface(graph.load(model))[0]


@pytest.mark.parametrize("modules", SCHEMES)
def test_several_modules_go_together(model: Path, tmp_path: Path, modules: str) -> None:
    made = without(modules, model, recording(tmp_path / "f", 1))

    left = tuple(name for name in OUTPUTS if name not in SCHEMES[modules])
    assert tuple(value.name for value in made.graph.outputs) == left


@pytest.mark.parametrize("module", DROPPED)
def test_on_the_only_frame_nothing_moves(
    model: Path, tmp_path: Path, module: str
) -> None:
    """The mean over one frame is that frame: the plan must be the same."""
    frames = recording(tmp_path / "f", 1)

    (before,), (after,) = (
        plans(each, frames) for each in (model, without(module, model, frames))
    )
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("module", DROPPED)
def test_on_many_frames_the_plan_moves(
    model: Path, tmp_path: Path, module: str
) -> None:
    frames = recording(tmp_path / "f", 4)
    before = np.array(plans(model, frames))
    after = np.array(plans(without(module, model, frames), frames))

    assert np.abs(after - before).max() > 1e-3
    assert np.abs(after - before).max() < 10


def test_what_is_left_still_drives(model: Path, tmp_path: Path) -> None:
    path = tmp_path / "minus-occ.onnx"
    graph.save(without("occ", model, recording(tmp_path / "f", 2)), path)

    policy = OnnxPolicy.open(path)
    assert policy.recurrent == {
        "prev_bev": "prev_bev_out",
        "prev_memory": "prev_memory_out",
    }


def test_without_frames_there_is_no_mean(model: Path) -> None:
    loaded = graph.load(model)

    with pytest.raises(FramesError, match="fill=means needs recorded frames"):
        PassManager(recipe.load("minus-occ")).run(loaded, Context(detect(loaded)))
