"""What a graph answers, read by an adapter: other waypoints, a host stage."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.contract import Trajectory
from me2e_compress.driving.host_stage import HostStage, HostWork
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import Floats, PlanAdapter
from tests.evaluators.highway.asked import observation
from tests.evaluators.highway.drivers import EXIT, straight_on


def adapted(model: Path, toml: str, stage: HostStage | None = None) -> OnnxDriver:
    adapter = model.with_suffix(".toml")
    adapter.write_text(toml)
    return OnnxDriver(model, adapter, host_stage=stage)


def controlled(tmp_path: Path, values: str = "0.5, 0.25, 0.0") -> Path:
    """Write a graph that plans straight on, and asks for these controls beside it."""
    return straight_on(
        tmp_path / "m.onnx",
        outputs="float[1, 6, 2] plan, float[1, 3] gas",
        body="plan = Identity (ahead) gas = Identity (asked)",
        initializers=f", float[1, 3] asked = {{{values}}}",
    )


def test_waypoints_of_any_number_in_the_models_axes(tmp_path: Path) -> None:
    """Ten of x, y and heading, flat, every 0.2 s from now on, x forward, y right."""
    flat = ", ".join(f"{k}, {0.5 * k}, 9.0" for k in range(10))
    model = straight_on(
        tmp_path / "m.onnx",
        outputs="float[1, 30] way",
        body="way = Identity (flat)",
        initializers=f", float[1, 30] flat = {{{flat}}}",
    )
    plan = (
        "output = 'way'\nshape = [10, 3]\ncolumns = [0, 1]\nstep_s = 0.2\nfirst_s = 0"
    )
    policy = adapted(model, f"axes = 'forward-right'\n[plan]\n{plan}").open()
    policy.reset(EXIT)

    result = policy.plan(observation())

    assert isinstance(result, Trajectory)
    assert result.points[[0, 8]].tolist() == [[1.0, -0.5], [9.0, -4.5]]
    assert result.times_s[[0, 8]].tolist() == [0.2, 1.8]


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("[control]\nsteer = 'gas'", "control: Extra inputs are not permitted"),
        ("[plan]\noutput = 'gas'\nstep_s = 0.5", "gas has shape [1, 3], a plan is"),
        ("[plan]\noutput = 'plan'\nstep_s = 0", "plan.step_s: Input should be greater"),
        ("[plan]\noutput = 'plan'\nshape = [6, 0]", "every side is 1 or more"),
        ("[plan]\noutput = 'plan'\ncommand_modes = [0]", "without command_input"),
        (
            "[plan]\noutput = 'plan'\ncommand_input = 'comand'",
            "no input comand, which picks the plan's mode (command_input); there are",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(tmp_path: Path, toml: str, message: str) -> None:
    with pytest.raises(EvaluationError) as caught:
        adapted(controlled(tmp_path), toml).open()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Same(HostStage):
    """Changes nothing."""

    name: ClassVar[str] = "same"

    def work(self, plan: Floats, outputs: Mapping[str, Array]) -> HostWork:
        return HostWork(plan)


def test_a_host_stage_takes_six_waypoints_of_any_plan(tmp_path: Path) -> None:
    """Three, a second apart, 4 m/s: those between are halfway."""
    model = straight_on(
        tmp_path / "m.onnx",
        outputs="float[1, 3, 2] plan",
        body="plan = Identity (way)",
        initializers=", float[1, 3, 2] way = {4, 0, 8, 1, 12, 1}",
    )
    plan = PlanAdapter(output="plan", step_s=1.0)
    policy = OnnxPolicy.open(model, Adapter(plan=plan), stage=Same())
    policy.reset(EXIT)

    result = policy.plan(observation())

    assert isinstance(result, Trajectory)
    assert result.points[:, 0].tolist() == [2.0, 4.0, 6.0, 8.0, 10.0, 12.0]
    assert result.points[2].tolist() == [6.0, 0.5]


MAP = """
[plan]
output = "way"
[modules.all]
role = "feature"
optional = ["**"]
"""


def test_a_module_map_of_another_graph_does_not_drive(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(MAP.replace("way", "path"))
    driver = OnnxDriver(controlled(tmp_path), module_map=str(tmp_path / "map.toml"))
    with pytest.raises(EvaluationError, match=r"^map map: no output path"):
        driver.open()
