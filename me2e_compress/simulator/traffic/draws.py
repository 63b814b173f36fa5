"""Parameters of a route, drawn by name."""

import zlib
from collections.abc import Sequence

import numpy as np

from me2e_compress.errors import EvaluationError
from me2e_compress.simulator.routes import Parameter, Route


class Draws:
    """Draws the parameters of a route, each by its name.

    A value depends on the route's seed and the name alone, not on what was drawn
    before, and a value in the route's manifest wins.
    """

    def __init__(self, route: Route) -> None:
        self.route = route
        self.parameters: dict[str, Parameter] = {}
        self.lead_m = 0.0
        """Metres of route before the places of a scenario."""
        self._traffic, self._complete = 0, False

    def place(self, name: str, low: float, high: float) -> float:
        """Draw an arc length of the route, after the metres that come before."""
        return self.uniform(name, low + self.lead_m, high + self.lead_m)

    def random(self, name: str) -> np.random.Generator:
        """Return a generator of traffic: another ``traffic`` gives other numbers."""
        key = [self.route.seed, self._traffic, zlib.crc32(name.encode())]
        return np.random.default_rng(key)

    def uniform(self, name: str, low: float, high: float) -> float:
        """Draw a parameter between two bounds, to the millimetre."""
        drawn = round(float(self._random(name).uniform(low, high)), 3)
        return float(self._given(name, drawn))

    def integer(self, name: str, low: int, high: int) -> int:
        """Draw an integer parameter between two bounds, both included."""
        return int(self._given(name, int(self._random(name).integers(low, high + 1))))

    def choice(self, name: str, options: Sequence[str]) -> str:
        """Draw one of several words."""
        drawn = options[int(self._random(name).integers(len(options)))]
        value = str(self._given(name, drawn))
        if value not in options:
            raise EvaluationError(
                f"route {self.route.id}: parameter {name} is {value!r}; "
                f"there are {', '.join(options)}"
            )
        return value

    def complete(self) -> None:
        """Check that the route gives no parameter that nothing drew."""
        self._complete = True
        unasked = [
            name for name in self.route.parameters if name not in self.parameters
        ]
        if unasked:
            raise EvaluationError(
                f"route {self.route.id}: {self.route.scenario} has no parameter "
                f"{', '.join(unasked)} here; there are {', '.join(self.parameters)}"
            )

    def _given(self, name: str, drawn: Parameter) -> Parameter:
        if self._complete:
            raise EvaluationError(
                f"{self.route.scenario}: parameter {name} is drawn after the setup"
            )
        value = self.route.parameters.get(name, drawn)
        if isinstance(value, str) != isinstance(drawn, str):
            raise EvaluationError(
                f"route {self.route.id}: parameter {name} is {value!r}, "
                f"expected a value like {drawn!r}"
            )
        self.parameters[name] = value
        return value

    def _random(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self.route.seed, zlib.crc32(name.encode())])
