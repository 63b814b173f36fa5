"""Conditions that a policy drives under: latency, step, cameras, weather.

They are separate from the runner, so that naming them does not import highway-env.
"""

import functools
from dataclasses import dataclass, field

from pydantic import TypeAdapter, ValidationError

from me2e_compress.driving.latency import FixedLatency, LatencySource
from me2e_compress.driving.realtime import DT_US, LatencyModel
from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.episode import FRAME_US
from me2e_compress.simulator.camera_rig import CLEAR, Weather


@dataclass(frozen=True)
class Conditions:
    """The conditions that a policy drives under.

    Args:
        dt_us: Step of the world, a divisor of 50 ms; `realtime.skipped_decisions` tells
            what a finer one changes. Frames are recorded every 50 ms regardless.
        image_size: Rows and columns of each camera.
        latency_model: Whether a latency drops decisions or delays every control.
        drive_on: Whether a route goes on after a collision, as in Bench2Drive.
    """

    latency: LatencySource = field(default_factory=FixedLatency)
    dt_us: int = DT_US
    image_size: tuple[int, int] = (96, 160)
    weather: Weather = CLEAR
    latency_model: LatencyModel = LatencyModel.DROP
    drive_on: bool = False

    def __post_init__(self) -> None:
        if self.latency.lacks_trace:
            raise EvaluationError(
                f"latency {self.latency}: its trace names no file (trace:FILE), and "
                "only a study knows each model's own latencies"
            )
        if self.dt_us <= 0 or FRAME_US % self.dt_us:
            raise EvaluationError(
                f"a step of {self.dt_us / 1e3:g} ms: it must divide "
                f"{FRAME_US // 1000} ms"
            )


@dataclass(frozen=True, kw_only=True)
class ConditionOptions:
    """What the command, a study's file and Python say alike of conditions, in words.

    Attributes:
        latency_model: ``drop`` the decisions due meanwhile, or ``fifo``: delay every
            control.
        dt_ms: time step of the simulation, in milliseconds; results at different steps
            are not compared.
        weather: ``fog_m=80,night=0.5,dropped=BACK+FRONT``; empty is what each route
            says.
        drive_on: go on after a collision, as Bench2Drive does; every collision then
            multiplies the score.
    """

    latency_model: str = "drop"
    dt_ms: float = 50.0
    weather: str = ""
    drive_on: bool = False

    @functools.cached_property
    def settings(self) -> Conditions:
        """Conditions with neither a latency nor the size of a policy's images.

        Raises:
            EvaluationError: An option is invalid.
        """
        return Conditions(
            dt_us=_step_us(self.dt_ms),
            weather=_weather_of(self.weather),
            latency_model=_latency_model_named(self.latency_model),
            drive_on=self.drive_on,
        )


def _latency_model_named(name: str) -> LatencyModel:
    if name not in list(LatencyModel):
        there = ", ".join(LatencyModel)
        raise EvaluationError(f"no latency model {name!r}; there are {there}")
    return LatencyModel(name)


def _step_us(dt_ms: float) -> int:
    """Return a step of the world in whole microseconds."""
    if not 0 < dt_ms <= FRAME_US / 1000:
        raise EvaluationError(
            f"a step of {dt_ms:g} ms: it must divide {FRAME_US // 1000} ms"
        )
    return round(dt_ms * 1000)


def _weather_of(text: str) -> Weather:
    """Read ``option=value`` pairs; dropped cameras are joined by ``+``."""
    options: dict[str, object] = {}
    for pair in filter(None, text.split(",")):
        name, _, value = pair.partition("=")
        options[name.strip()] = value.split("+") if name == "dropped" else value
    unknown = [name for name in options if name not in Weather.__dataclass_fields__]
    if unknown:
        raise EvaluationError(
            f"weather option {unknown[0]!r}: there are "
            f"{', '.join(Weather.__dataclass_fields__)}"
        )
    try:
        return TypeAdapter(Weather).validate_python(options)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise EvaluationError(
            f"weather option {first['loc'][0]}: {first['msg']}"
        ) from error
