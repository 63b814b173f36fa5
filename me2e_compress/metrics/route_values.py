"""One number of every route of a drive: its mean, and differences from another drive's.

Whatever is compared between two drives is compared here, route by route.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from me2e_compress.metrics.intervals import Bounds, mean_estimate
from me2e_compress.metrics.measure import Estimate, Measure

POINTS = "points"
"""Difference of two percentages."""


class DrivenRoute(Protocol):
    """A route of a drive: an episode, or what was kept of one."""

    @property
    def route(self) -> str:
        """Name of the route."""
        ...

    @property
    def scenario(self) -> str:
        """Its scenario type."""
        ...


Driven = TypeVar("Driven", bound=DrivenRoute)


@dataclass(frozen=True)
class RouteValues:
    """Numbers of the routes that have one, and the scenario types of these routes.

    Subtracting another drive's values leaves the routes that both have; bounds are the
    smallest and largest value of a route, if there are any.
    """

    name: str
    unit: str
    by_route: Mapping[str, float]
    types: Mapping[str, str]
    bounds: Bounds | None = None
    missing: str = "no route has a {name}"

    def __sub__(self, other: "RouteValues") -> "RouteValues":
        bounds = None
        if self.bounds is not None and other.bounds is not None:
            (low, high), (least, most) = self.bounds, other.bounds
            bounds = low - most, high - least
        return RouteValues(
            self.name,
            POINTS if self.unit == "%" else self.unit,
            {
                route: value - other.by_route[route]
                for route, value in self.by_route.items()
                if route in other.by_route
            },
            self.types,
            bounds,
            "no route has a {name} in both drives",
        )

    def mean(self, seed: int = 0) -> Estimate:
        """Return the mean over routes with its intervals."""
        if not self.by_route:
            why = self.missing.format(name=self.name)
            return Estimate(Measure(None, self.unit, why), None, None, 0)
        types = [self.types[route] for route in self.by_route]
        values = list(self.by_route.values())
        return mean_estimate(values, types, self.unit, seed, self.bounds)


@dataclass(frozen=True)
class RouteColumn(Generic[Driven]):
    """One number of every route; None if it was not measured."""

    name: str
    unit: str
    of: Callable[[Driven], float | None]
    bounds: Bounds | None = None

    def values(self, routes: Sequence[Driven]) -> RouteValues:
        """Return the numbers of a drive."""
        return RouteValues(
            self.name,
            self.unit,
            {
                each.route: value
                for each in routes
                if (value := self.of(each)) is not None
            },
            {each.route: each.scenario for each in routes},
            self.bounds,
        )
