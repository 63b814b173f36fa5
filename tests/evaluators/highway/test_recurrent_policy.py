"""Models with a state: fed forward, reset with a route, told how much time passed."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.contract import Observation, Plan, RouteInfo
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.runner import drive
from tests.evaluators.highway.asked import observation, planned
from tests.evaluators.highway.drivers import EXIT, straight_on

COUNTER = {
    "inputs": "float[18] can_bus, float[1, 6, 2] steps",
    "body": "steps_out = Add (steps, one) plan = Identity (steps_out)",
    "outputs": "float[1, 6, 2] plan, float[1, 6, 2] steps_out",
    "initializers": ", float one = {1.0}",
}


def test_recurrent_state_is_fed_forward_and_reset(tmp_path: Path) -> None:
    policy = OnnxPolicy.open(straight_on(tmp_path / "m.onnx", **COUNTER))  # type: ignore[arg-type]
    counted = []
    for _ in range(2):
        policy.reset(EXIT)
        counted += [planned(policy, observation())[0, 0] for _ in range(3)]

    assert counted == [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]


CLOCK = {
    "inputs": "float[1] timestamp, float[1] last",
    "body": """
        since = Sub (timestamp, last)
        plan = Add (zero, since)
        last_out = Identity (timestamp)""",
    "outputs": "float[1, 6, 2] plan, float[1] last_out",
    "initializers": ", float[1, 6, 2] zero = {" + ", ".join(["0.0"] * 12) + "}",
}


@dataclasses.dataclass
class Listening:
    """Stands still, and writes down what the model answers."""

    model: OnnxPolicy
    heard: list[float] = dataclasses.field(default_factory=list)
    needs_images: bool = False
    privileged: bool = False

    def reset(self, route: RouteInfo) -> None:
        self.model.reset(route)

    def plan(self, observation: Observation) -> Plan:
        self.heard.append(float(planned(self.model, observation)[0, 0]))
        return np.zeros((6, 2))


@pytest.mark.parametrize("name", ["timestamp", "seconds"])
def test_a_recurrent_model_knows_how_far_apart_its_frames_are(
    tmp_path: Path, name: str
) -> None:
    renamed = {key: text.replace("timestamp", name) for key, text in CLOCK.items()}
    path = straight_on(tmp_path / "m.onnx", **renamed)  # type: ignore[arg-type]
    policy = OnnxPolicy.open(path, Adapter(inputs={"timestamp": name}))
    elapsed = []
    for _ in range(2):
        policy.reset(EXIT)
        for time_us in (0, 350_000, 400_000):
            seen = dataclasses.replace(observation(), time_us=time_us)
            elapsed.append(planned(policy, seen)[0, 0])

    assert elapsed == pytest.approx([0.0, 0.35, 0.05] * 2)


def test_the_clock_starts_with_the_route(tmp_path: Path) -> None:
    """A plan of as many metres as seconds: the first decision is told 0."""
    body = "plan = Add (zero, timestamp)"
    clock = {**CLOCK, "inputs": "float[1] timestamp", "body": body}
    clock["outputs"] = "float[1, 6, 2] plan"
    model = straight_on(tmp_path / "m.onnx", **clock)  # type: ignore[arg-type]
    policy = Listening(OnnxPolicy.open(model))

    episode = drive(EXIT, policy, Drive())

    decided = [decision.time_us / 1e6 for decision in episode.decisions]
    assert policy.heard == pytest.approx(decided)
    assert policy.heard[0] == 0.0


def test_an_adapter_names_the_recurrent_pair(tmp_path: Path) -> None:
    named = {key: text.replace("steps_out", "state") for key, text in COUNTER.items()}
    path = straight_on(tmp_path / "m.onnx", **named)  # type: ignore[arg-type]

    with pytest.raises(EvaluationError, match="input steps is none of img, lidar2img"):
        OnnxPolicy.open(path)
    policy = OnnxPolicy.open(
        path, Adapter.model_validate({"recurrent": {"steps": "state"}})
    )
    policy.reset(EXIT)

    assert [planned(policy, observation())[5, 1] for _ in range(2)] == [1.0, 2.0]
