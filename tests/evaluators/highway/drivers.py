"""Drivers that misbehave, and routes that are short."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import numpy.typing as npt
import onnx

from me2e_compress.driving.contract import (
    Answer,
    Observation,
    PedalsAndWheel,
    Policy,
    RouteInfo,
)
from me2e_compress.driving.policies import Driver
from me2e_compress.simulator.routes import Route
from models.driver.expert.blind import Blind

CROSSING = Route("crossing", "DynamicObjectCrossing", 1)
PARKED = Route("parked", "ParkedObstacle", 1)
GREEN = Route("green", "VanillaSignalizedTurnEncounterGreenLight", 1)
EXIT = Route("exit", "HighwayExit", 1)
ROUTES = (CROSSING, PARKED, GREEN, EXIT)


@dataclass
class Misbehaving:
    """Drives blindly, and at its 20th decision does what it is called."""

    way: str
    needs_images: bool = False
    privileged: bool = True

    def reset(self, route: RouteInfo) -> None:
        self.decisions, self.blind = 0, Blind()
        self.blind.reset(route)
        if self.way == "no-reset":
            raise RuntimeError("will not start")

    def plan(self, observation: Observation) -> Answer:
        self.decisions += 1
        plan = self.blind.plan(observation)
        return plan if self.decisions < 20 else self.misbehave(plan)

    def misbehave(self, plan: npt.NDArray[np.floating]) -> Answer:
        if self.way == "raise":
            raise KeyError("lost\nmy way")
        if self.way == "hang":
            time.sleep(3600)
        if self.way == "die":
            os._exit(7)
        if self.way == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        answers: dict[str, Any] = {
            "not-finite": np.where(np.arange(12).reshape(6, 2) == 5, np.nan, plan),
            "steers-too-far": PedalsAndWheel(0.5, 1.3, 0.0),
            "no-pedal": PedalsAndWheel(float("nan"), 0.0, 0.0),
            "shape": plan[:5],
            "integers": plan.astype(int),
            "list": [1, 2],
        }
        return cast("Answer", answers[self.way])


@dataclass(frozen=True)
class MisbehavingDriver(Driver):
    """Opens the above in any process."""

    name: ClassVar[str] = "misbehaving"
    way: str

    def open(self) -> Policy:
        return Misbehaving(self.way)


def straight_on(
    path: Path,
    *,
    inputs: str = "int64[1] command",
    body: str = "plan = Identity (ahead)",
    outputs: str = "float[1, 6, 2] plan",
    initializers: str = "",
    metadata: dict[str, str] | None = None,
) -> Path:
    """Write a model; its default plan goes 4 m/s straight ahead."""
    ahead = ", ".join(f"{2.0 * k}, 0.0" for k in range(1, 7))
    text = f"""<ir_version: 8, opset_import: ["" : 17]>
    driver ({inputs}) => ({outputs})
    <float[1, 6, 2] ahead = {{{ahead}}} {initializers}> {{ {body} }}"""
    model = onnx.parser.parse_model(text)
    for key, value in (metadata or {}).items():
        model.metadata_props.add(key=key, value=value)
    onnx.save(model, path)
    return path


def slow_here(path: Path) -> Path:
    """Write one that plans the same, quantized in TensorRT's form."""
    return straight_on(
        path,
        body="""q = QuantizeLinear(ahead, s, z) d = DequantizeLinear(q, s, z)
            v = DequantizeLinear(w, s, z) m = MatMul(d, v) plan = Add(m, b)""",
        initializers=", float s = {0.1}, int8 z = {0}, int8[2,2] w = {10, 0, 0, 10},"
        " float[2] b = {0, 0}",
    )
