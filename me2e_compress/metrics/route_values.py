"""One number of every route of a drive: its mean, and differences from another drive's.

Whatever is compared between two drives is compared here, route by route.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from me2e_compress.metrics.intervals import Bounds, mean_estimate
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import RouteSummary

POINTS = "points"
"""Difference of two percentages."""
PERCENT, SHARE = (0.0, 100.0), (0.0, 1.0)
"""Bounds of a route's values."""


@dataclass(frozen=True)
class RouteValues:
    """Numbers of the routes that have one, and the scenario types of these routes.

    Subtracting another drive's values leaves the routes that both have; bounds are the
    smallest and largest value of a route, if there are any. ``missing`` says why no
    route has a number.
    """

    name: str
    unit: str
    by_route: Mapping[str, float]
    types: Mapping[str, str]
    bounds: Bounds | None
    missing: str

    def __sub__(self, other: "RouteValues") -> "RouteValues":
        bounds = None
        if self.bounds is not None and other.bounds is not None:
            (low, high), (least, most) = self.bounds, other.bounds
            bounds = low - most, high - least
        shared = {
            route: value - other.by_route[route]
            for route, value in self.by_route.items()
            if route in other.by_route
        }
        # a drive without a single number says why
        missing = f"no route has a {self.name} in both drives"
        if not (self.by_route and other.by_route):
            missing = other.missing if self.by_route else self.missing
        unit = POINTS if self.unit == "%" else self.unit
        return replace(self, unit=unit, by_route=shared, bounds=bounds, missing=missing)

    def mean(self, seed: int = 0) -> Estimate:
        """Return the mean over routes with its intervals."""
        if not self.by_route:
            return Estimate.missing(self.unit, self.missing)
        types = [self.types[route] for route in self.by_route]
        values = list(self.by_route.values())
        return mean_estimate(values, types, self.unit, seed, self.bounds)


@dataclass(frozen=True)
class RouteColumn:
    """One number of every route; None if it was not measured."""

    name: str
    unit: str
    of: Callable[[RouteSummary], float | None]
    bounds: Bounds | None = None

    def values(self, routes: Sequence[RouteSummary], why: str = "") -> RouteValues:
        """Return the numbers of a drive; ``why`` there are no routes, if so."""
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
            why or f"no route has a {self.name}",
        )


DS = RouteColumn("DS", "%", lambda route: route.driving_score, PERCENT)
SR = RouteColumn("SR %", "%", lambda route: 100.0 * route.succeeded, PERCENT)
DE = RouteColumn("DE %", "%", lambda route: route.efficiency)
DC = RouteColumn("DC", "ratio", lambda route: route.comfort, SHARE)
ROOM = RouteColumn("room %", "%", lambda route: route.room_kept, PERCENT)
DE_B2D = RouteColumn("DE b2d %", "%", lambda route: route.bench2drive_efficiency)
DC_B2D = RouteColumn(
    "DC b2d", "ratio", lambda route: route.bench2drive_smoothness, SHARE
)
COLUMNS = (DS, ROOM, SR, DE, DE_B2D, DC, DC_B2D)
"""The paper's scores of a route; b2d: in the arithmetic of Bench2Drive's tools."""
