"""An adapter counts wherever a graph is run, not only where it drives."""

import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import EvaluationError, FramesError
from me2e_compress.commands.calibrate import calibrate
from me2e_compress.commands.compare import compare
from me2e_compress.commands.compress import compress
from me2e_compress.commands.inspect import inspect
from me2e_compress.commands.options import (
    CalibrateOptions,
    CompareOptions,
    CompressOptions,
    InspectOptions,
    ProfileOptions,
    SensitivityOptions,
)
from me2e_compress.commands.profile import profile
from me2e_compress.commands.search import measure_sensitivity
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.outputs import write_port_metadata
from me2e_compress.fidelity.compare import SetOutputs
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.shipped.drivers import map_name, shipped_model
from tests.support.frames import record
from tests.support.nets import parsed

MINE = """
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
    graph.save(parsed(text), tmp_path / "mine.onnx")
    return tmp_path / "mine.onnx"


@pytest.fixture
def adapter(tmp_path: Path) -> Path:
    (tmp_path / "a.toml").write_text(ADAPTER)
    return tmp_path / "a.toml"


PARTS = """
[modules.all]
role = "feature"
optional = ["**"]
"""


@pytest.fixture
def parts(tmp_path: Path) -> Path:
    """A module map that says what the adapter says of plan and state."""
    stated = ADAPTER.replace('[feeds.seen]\nsource = "speed"\n', "")
    (tmp_path / "parts.toml").write_text(PARTS + stated)
    return tmp_path / "parts.toml"


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    seen = np.random.default_rng(1).standard_normal((4, 1, 8, 12)).astype(np.float32)
    return record(tmp_path / "frames", [{"seen": each} for each in seen])


def test_compare_knows_the_plan_and_the_state(
    mine: Path, frames: Path, adapter: Path
) -> None:
    with pytest.raises(FramesError, match="memory is missing"):
        compare(mine, mine, frames)

    found = compare(mine, mine, frames, CompareOptions(adapter=adapter)).fidelity

    assert found.plan is not None
    assert found.plan_output == "waypoints"
    shown = inspect(mine, InspectOptions(adapter=adapter))
    assert shown.recurrent == {"memory": "remembered"}


def test_a_map_says_which_outputs_are_sets(mine: Path, tmp_path: Path) -> None:
    sets, model = tmp_path / "sets.toml", graph.load(mine)
    named = '[sets]\nboxes = "remembered"\nscores = "remembered"\nothers = {}\n'
    sets.write_text(PARTS + named.format('["waypoints"]'))
    write_port_metadata(model, None, sets)
    own = SetOutputs.of(
        model.metadata_props, {"remembered": (1, 8), "waypoints": (1, 8)}
    )
    assert own == SetOutputs(
        boxes="remembered", scores="remembered", others=("waypoints",)
    )
    sets.write_text(PARTS + named.format('["nowhere"]'))
    with pytest.raises(EvaluationError, match="map sets: sets: no output nowhere"):
        write_port_metadata(graph.load(mine), None, sets)
    assert map_name(shipped_model("highway")) == "highway"
    assert map_name(mine) is None


def test_all_that_run_a_graph_feed_the_state_back(
    mine: Path, frames: Path, adapter: Path, tmp_path: Path
) -> None:
    ranges, small = tmp_path / "ranges.json", tmp_path / "small.onnx"

    calibrate(mine, frames, ranges, CalibrateOptions(adapter=adapter))
    compress(mine, small, "exact", frames, CompressOptions(adapter=adapter))

    found = compare(small, small, frames).fidelity  # it says so itself now
    assert found.plan_output == "waypoints"
    assert json.loads(ranges.read_text())["frames"] == 4
    by_module = ProfileOptions(by_module=True, adapter=adapter)
    timed = profile(mine, frames, tmp_path / "trace.json", by_module)
    assert len(timed.trace.samples_us) == 4
    assert timed.trace.modules_us
    options = SensitivityOptions(adapter=adapter, node_trials=0)
    cost = measure_sensitivity(mine, frames, tmp_path / "int8.toml", options)
    assert cost.sensitivity.together.unit == "m"  # without a drive


@pytest.mark.parametrize(
    ("of_map", "before", "after", "why"),
    [
        (False, "feeds.seen", "feeds.sight", "feeds input sight; there are seen, mem"),
        (False, '"waypoints"', '"way"', "no output way"),
        (False, '"remembered"', '"kept"', "pairs memory with kept"),
        (True, '"waypoints"', '"way"', "no output way, which is named as the plan"),
        (True, '"remembered"', '"kept"', "pairs memory with kept"),
        (True, "memory =", "past =", "pairs past with remembered"),
        (True, '"waypoints"', '"waypoints"\ncommand_input = "turn"', "no input turn"),
        (True, "output =", "outptu =", "plan.output: Field required"),
        (True, '"waypoints"', '"waypoints"\nstep_s = -1', "plan.step_s: .* than 0"),
    ],
)
def test_an_adapter_or_a_map_of_another_graph_is_refused(
    mine: Path, adapter: Path, parts: Path,
    of_map: bool, before: str, after: str, why: str,
) -> None:  # fmt: skip
    file = parts if of_map else adapter
    file.write_text(file.read_text().replace(before, after))
    given = (None, parts) if of_map else (adapter,)

    start = "^map parts:?" if of_map else r"a\.toml:"
    with pytest.raises(EvaluationError, match=f"{start} .*{why}"):
        write_port_metadata(graph.load(mine), *given)


def test_the_command_that_picks_a_mode_has_the_name_of_the_graph() -> None:
    plan = PlanAdapter(output="plan", command_input="command")

    said = Adapter(inputs={"command": "navigation"}, plan=plan).metadata({})

    assert json.loads(said["me2e.plan"])["command_input"] == "navigation"


def test_an_adapter_overrides_the_map(mine: Path, adapter: Path, parts: Path) -> None:
    parts.write_text(parts.read_text() + "step_s = 0.1\n")

    said = write_port_metadata(graph.load(mine), adapter, parts)

    assert "step_s" not in said["me2e.plan"]


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ('plan = { output = "waypoints" }', "waypoints"),
        ('plan = { output = "way" }', None),
        ('plan = { output = "waypoints" }\nrecurrent = { memory = "kept" }', None),
    ],
)
def test_optional_names_hold_where_all_are_there(
    mine: Path, parts: Path, table: str, expected: str | None
) -> None:
    parts.write_text(f"{PARTS}\n[[optional]]\n{table}")

    said = write_port_metadata(graph.load(mine), None, parts)

    found = json.loads(said["me2e.plan"])["output"] if said else None
    assert found == expected


def test_optional_names_leave_what_the_graph_says_of_itself(
    mine: Path, parts: Path
) -> None:
    model = graph.load(mine)
    model.metadata_props["me2e.plan"] = '{"output": "waypoints"}'
    model.metadata_props["me2e.recurrent"] = '{"memory": null}'
    optional = '[[optional]]\nplan = { output = "remembered" }'
    state = 'recurrent = { memory = "remembered" }'
    parts.write_text(f"{PARTS}\n{optional}\n{state}")

    assert write_port_metadata(model, None, parts) == {}


PRESETS = [
    ("vad", "ego_fut_preds", "prev_bev", "bev_embed"),
    ("uniad", "sdc_traj", "prev_bev", "bev_embed"),
    ("uniad", "outs_planning", "prev_bev", "bev_embed"),
    ("tcp", "pred_wp", "state", "state_out"),
    ("highway", "plan", "prev_bev", "prev_bev_out"),
]


@pytest.mark.parametrize(("preset", "plan", "taken", "given"), PRESETS)
def test_presets_name_plan_and_state(
    preset: str, plan: str, taken: str, given: str
) -> None:
    text = MINE.replace("WEIGHT", ", ".join(["0.0"] * 144)).replace("waypoints", plan)
    model = parsed(text.replace("memory", taken).replace("remembered", given))

    write_port_metadata(model, None, preset)

    assert json.loads(model.metadata_props["me2e.plan"])["output"] == plan
    assert recurrent_inputs(model) == {taken: given}
