"""The recipes that take one module from the driver, on a small one like it."""

from collections.abc import Callable
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
from tests.stand_in import OUTPUTS, record_driver, write_model

OUTPUT = {
    "track": "agents",
    "map": "lanes",
    "motion": "motions",
    "occ": "occupancy",
}
SCHEMES = (*OUTPUT, "map-motion", "occ-motion", "occ-map", "occ-map-motion")

Without = Callable[[str, int], tuple[ir.Model, CalibrationSet]]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("driver") / "m.onnx")


@pytest.fixture
def without(model: Path, tmp_path: Path) -> Without:
    """Take modules from it by the recipe, after so many frames."""

    def run(modules: str, count: int) -> tuple[ir.Model, CalibrationSet]:
        frames = CalibrationSet(record_driver(tmp_path / "f", count))
        loaded = graph.load(model)
        context = Context(detect(loaded), frames)
        passes = recipe.load(f"minus-{modules}")
        return PassManager(passes).run(loaded, context).model, frames

    return run


@pytest.mark.parametrize("modules", SCHEMES)
def test_modules_are_gone_with_their_outputs(
    model: Path, without: Without, modules: str
) -> None:
    made, _ = without(modules, 3)

    gone = modules.split("-")
    assert not {provenance.module_of(node) for node in made.graph} & {*gone}
    left = OUTPUTS.keys() - {OUTPUT[module] for module in gone}
    assert [v.name for v in made.graph.outputs] == [n for n in OUTPUTS if n in left]
    assert graph.interface(made)[0] == graph.interface(graph.load(model))[0]


def plans(model: ir.Model | Path, frames: CalibrationSet) -> npt.NDArray[np.float32]:
    answers = replay(Session(model), frames, ["plan"])
    return np.array([each["plan"] for each in answers], np.float32)


@pytest.mark.parametrize(("count", "least", "most"), [(1, 0, 1e-5), (4, 1e-3, 10)])
@pytest.mark.parametrize("module", OUTPUT)
def test_the_plan_moves_with_the_frames_the_mean_is_taken_over(
    model: Path, without: Without, module: str, count: int, least: float, most: float
) -> None:
    """The mean over one frame is that frame: there nothing moves."""
    made, frames = without(module, count)

    assert least <= np.abs(plans(made, frames) - plans(model, frames)).max() < most


def test_what_is_left_still_drives(without: Without, tmp_path: Path) -> None:
    path = tmp_path / "minus-occ.onnx"
    graph.save(without("occ", 2)[0], path)

    policy = OnnxPolicy.open(path)
    assert policy.recurrent == {
        "prev_bev": "prev_bev_out",
        "prev_memory": "prev_memory_out",
    }


def test_without_frames_there_is_no_mean(model: Path) -> None:
    loaded = graph.load(model)

    with pytest.raises(FramesError, match="fill=means needs recorded frames"):
        PassManager(recipe.load("minus-occ")).run(loaded, Context(detect(loaded)))
