"""An adapter counts wherever a graph is run, not only where it drives."""

import json
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.driving.adapter import Adapter
from me2e_compress.errors import EvaluationError, FramesError, RecipeError
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.runtime.stack_session import open_session
from me2e_compress.workflows.calibrate import calibrate
from me2e_compress.workflows.calibrate_options import CalibrateOptions
from me2e_compress.workflows.checks import adapted
from me2e_compress.workflows.compare import compare
from me2e_compress.workflows.compress import CompressOptions, compress
from me2e_compress.workflows.inspect import inspect
from me2e_compress.workflows.profile import ProfileOptions, profile
from me2e_compress.workflows.sensitivity import SensitivityOptions, measure_sensitivity
from tests.stacks import write_stack

MINE = """
<ir_version: 9, opset_import: ["" : 17]>
mine (float[1,8,12] seen, float[1,8,12] memory)
    => (float[1,48,2] waypoints, float[1,8,12] remembered)
    <float[12,12] weight = {WEIGHT}, int64[3] shape = {1, 48, 2}>
{
    mixed = Add(seen, memory)
    remembered = MatMul(mixed, weight)
    waypoints = Reshape(remembered, shape)
}
"""
ADAPTER = """
[feeds.seen]
source = "speed"

[recurrent]
memory = "remembered"

[plan]
output = "waypoints"
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    weight = np.random.default_rng(0).standard_normal(144) / 4
    text = MINE.replace("WEIGHT", ", ".join(f"{each:.6f}" for each in weight))
    graph.save(ir.from_onnx_text(text), tmp_path / "mine.onnx")
    return tmp_path / "mine.onnx"


@pytest.fixture
def adapter(tmp_path: Path) -> Path:
    (tmp_path / "a.toml").write_text(ADAPTER)
    return tmp_path / "a.toml"


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    folder, random = tmp_path / "frames", np.random.default_rng(1)
    folder.mkdir()
    for at in range(4):
        seen = random.standard_normal((1, 8, 12)).astype(np.float32)
        np.savez(folder / f"{at:06d}.npz", seen=seen)
    (folder / "scenes.json").write_text('{"scenes": [0]}')
    return folder


def test_compare_knows_the_plan_and_the_state(
    mine: Path, frames: Path, adapter: Path
) -> None:
    with pytest.raises(FramesError, match="memory is missing"):
        compare(mine, mine, frames)

    found = compare(mine, mine, frames, adapter=adapter).fidelity

    assert found.plan is not None
    assert found.plan_output == "waypoints"


def test_calibrate_and_compress_feed_the_state_back(
    mine: Path, frames: Path, adapter: Path, tmp_path: Path
) -> None:
    ranges, small = tmp_path / "ranges.json", tmp_path / "small.onnx"

    calibrate(mine, frames, ranges, CalibrateOptions(adapter=adapter))
    compress(mine, small, "exact", frames, CompressOptions(adapter=adapter))

    found = compare(small, small, frames).fidelity  # it says so itself now
    assert found.plan_output == "waypoints"
    assert json.loads(ranges.read_text())["frames"] == 4


def test_profile_feeds_the_state_back(
    mine: Path, frames: Path, adapter: Path, tmp_path: Path
) -> None:
    options = ProfileOptions(by_module=True, adapter=adapter)

    found = profile(mine, frames, tmp_path / "trace.json", options)

    assert len(found.trace.samples_us) == 4
    assert found.trace.modules_us


def test_inspect_shows_the_state(mine: Path, frames: Path, adapter: Path) -> None:
    found = inspect(mine, frames=frames, adapter=adapter)

    assert found.recurrent == {"memory": "remembered"}
    assert found.latency_of


def test_sensitivity_is_told_in_metres_without_a_drive(
    mine: Path, frames: Path, adapter: Path, tmp_path: Path
) -> None:
    options = SensitivityOptions(adapter=adapter, node_trials=0)

    found = measure_sensitivity(mine, frames, tmp_path / "int8.toml", options)

    assert found.found.together.unit == "m"


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        ("feeds.seen", "feeds.sight", "feeds input sight; there are seen, memory"),
        ('"waypoints"', '"way"', "no output way"),
        ('"remembered"', '"kept"', "pairs memory with kept"),
    ],
)
def test_an_adapter_of_another_graph_is_refused(
    mine: Path, adapter: Path, before: str, after: str, why: str
) -> None:
    adapter.write_text(ADAPTER.replace(before, after))

    with pytest.raises(EvaluationError, match=rf"a\.toml: .*{why}"):
        adapted(graph.load(mine), adapter)


def test_the_command_that_picks_a_mode_has_the_name_of_the_graph() -> None:
    plan = PlanAdapter(output="plan", command_input="command")

    said = Adapter(inputs={"command": "navigation"}, plan=plan).metadata({})

    assert json.loads(said["me2e.plan"])["command_input"] == "navigation"


def test_files_of_a_stack_take_no_adapter(
    tmp_path: Path, frames: Path, adapter: Path
) -> None:
    stack, out = write_stack(tmp_path), tmp_path / "out"

    with pytest.raises(RecipeError, match="--adapter is for one file"):
        compress(stack, out, "exact", frames, CompressOptions(adapter=adapter))
    with pytest.raises(RecipeError, match="--adapter is for one file"):
        calibrate(stack, frames, out, CalibrateOptions(adapter=adapter))


def test_what_is_said_of_a_stack_wins_over_its_own(tmp_path: Path) -> None:
    stack = write_stack(tmp_path)
    plain = open_session(stack)
    name = next(iter(plain.recurrent))

    silent = open_session(stack, said={"me2e.recurrent": json.dumps({name: None})})

    assert name not in silent.recurrent
    assert set(plain.recurrent) - set(silent.recurrent) == {name}
