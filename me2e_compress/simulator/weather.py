"""Weather and sensor faults that a route can be driven in."""

from dataclasses import dataclass

from me2e_compress.errors import EvaluationError
from me2e_compress.simulator.camera_rig import CAMERA_NAMES


@dataclass(frozen=True, slots=True)
class Weather:
    """Weather and sensor faults. The default is a clear day.

    Args:
        fog_m: Meteorological visibility in metres (contrast 5 %); None for no fog.
        night: 0 for day to 1 for a night lit by the ego's head lamps alone.
        rain: 0 to 1: streaks, a grey sky and noise.
        brightness: Factor on all pixels, 0 to 4: exposure, or a dirty lens.
        noise: Standard deviation of the sensor's noise in grey levels, 0 to 64.
        dropped: Names of cameras that fail: their images are black.
        seed: Seed of rain and noise.

    Raises:
        EvaluationError: An option is out of range or a camera is unknown.
    """

    fog_m: float | None = None
    night: float = 0.0
    rain: float = 0.0
    brightness: float = 1.0
    noise: float = 0.0
    dropped: tuple[str, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if self.fog_m is not None and not 1.0 <= self.fog_m <= 100_000.0:
            raise EvaluationError(
                f"weather option fog_m = {self.fog_m} is out of range: "
                "1 to 100000 metres, or None"
            )
        for name, value, most in (
            ("night", self.night, 1.0),
            ("rain", self.rain, 1.0),
            ("brightness", self.brightness, 4.0),
            ("noise", self.noise, 64.0),
        ):
            if not 0.0 <= value <= most:
                raise EvaluationError(
                    f"weather option {name} = {value} is out of range: 0 to {most:g}"
                )
        for camera in self.dropped:
            if camera not in CAMERA_NAMES:
                raise EvaluationError(
                    f"weather option dropped: no camera {camera!r}; there are "
                    f"{', '.join(CAMERA_NAMES)}"
                )
        if self.seed < 0:
            raise EvaluationError(
                f"weather option seed = {self.seed} is out of range: 0 or more"
            )


CLEAR = Weather()


DRAWN = ("clear",) * 8 + ("rain", "night", "fog", "dirt")
"""Weather of routes: a third of them have some."""


def drawn_weather(kind: str, strength: float, seed: int) -> Weather:
    """Return weather of `DRAWN`; the strength is 0 to 1."""
    if kind == "rain":
        return Weather(rain=0.3 + 0.7 * strength, seed=seed)
    if kind == "night":
        return Weather(night=0.5 + 0.5 * strength)
    if kind == "fog":
        return Weather(fog_m=round(150.0 - 90.0 * strength, 1))
    if kind == "dirt":
        return Weather(brightness=1.0 - 0.4 * strength, noise=12.0 * strength)
    return CLEAR
