"""Conditions that a policy drives under: latency, step, cameras, weather.

They are separate from the runner, so that naming them does not import highway-env.
"""

from dataclasses import dataclass, field

from me2e_compress.driving.latency import FixedLatency, LatencySource
from me2e_compress.driving.realtime import DT_US, LatencyModel
from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.episode import FRAME_US
from me2e_compress.simulator.weather import CLEAR, Weather


@dataclass(frozen=True)
class Conditions:
    """The conditions that a policy drives under.

    Args:
        dt_us: Step of the world, a divisor of 50 ms; `realtime.skipped_decisions` tells
            what a finer one changes. Frames are recorded every 50 ms regardless.
        image_size: Rows and columns of each camera.
        latency_model: Whether a latency drops decisions or delays every control.
    """

    latency: LatencySource = field(default_factory=FixedLatency)
    dt_us: int = DT_US
    image_size: tuple[int, int] = (96, 160)
    weather: Weather = CLEAR
    latency_model: LatencyModel = LatencyModel.DROP

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


def latency_model_named(name: str) -> LatencyModel:
    """Return the latency model of a name."""
    if name not in list(LatencyModel):
        there = ", ".join(LatencyModel)
        raise EvaluationError(f"no latency model {name!r}; there are {there}")
    return LatencyModel(name)


def step_us(dt_ms: float) -> int:
    """Return a step of the world, at most one frame, in whole microseconds."""
    if not 0 < dt_ms <= FRAME_US / 1000:
        raise EvaluationError(
            f"a step of {dt_ms:g} ms: it must divide {FRAME_US // 1000} ms"
        )
    return round(dt_ms * 1000)
