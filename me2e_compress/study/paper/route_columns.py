"""Means over routes, and paired differences, of the values in drive records."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from me2e_compress.metrics.intervals import Bounds, mean_estimate
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.drive_record import DriveRecord, RouteSummary


@dataclass(frozen=True)
class RouteColumn:
    """One number of every route; None if it was not measured."""

    name: str
    unit: str
    of: Callable[[RouteSummary], float | None]
    bounds: Bounds | None = None


DS = RouteColumn("DS", "%", lambda route: route.driving_score, (0.0, 100.0))
SR = RouteColumn("SR %", "%", lambda route: 100.0 * route.succeeded, (0.0, 100.0))
DE = RouteColumn("DE %", "%", lambda route: route.efficiency)
DC = RouteColumn("DC", "ratio", lambda route: route.comfort, (0.0, 1.0))
COLUMNS = (DS, SR, DE, DC)


def mean_of(record: DriveRecord, column: RouteColumn, seed: int = 0) -> Estimate:
    """Return a mean over routes with its intervals."""
    found = {
        each.route: value
        for each in record.routes
        if (value := column.of(each)) is not None
    }
    if not found:
        return _none(column.unit, f"no route has a {column.name}")
    values, types = list(found.values()), _types(record, found)
    return mean_estimate(values, types, column.unit, seed, column.bounds)


def paired(
    record: DriveRecord,
    reference: DriveRecord,
    column: RouteColumn,
    seed: int = 0,
) -> Estimate:
    """Return the mean of "this minus the reference" over the routes that have both."""
    return mean_gap(gaps(record, reference, column), record, column, seed)


def gaps(
    record: DriveRecord, reference: DriveRecord, column: RouteColumn
) -> dict[str, float]:
    """Return "this minus the reference", by route, where both have a value."""
    others = {route.route: column.of(route) for route in reference.routes}
    found = dict[str, float]()
    for route in record.routes:
        one, other = column.of(route), others.get(route.route)
        if one is not None and other is not None:
            found[route.route] = one - other
    return found


def mean_gap(
    found: Mapping[str, float],
    record: DriveRecord,
    column: RouteColumn,
    seed: int = 0,
    of: int = 1,
) -> Estimate:
    """Return the mean of differences; ``of`` is 2 for differences of differences."""
    unit = "points" if column.unit == "%" else column.unit
    if not found:
        return _none(unit, f"no route has a {column.name} in both drives")
    bounds = None
    if column.bounds is not None:
        most = of * (column.bounds[1] - column.bounds[0])
        bounds = -most, most
    values, types = list(found.values()), _types(record, found)
    return mean_estimate(values, types, unit, seed, bounds)


def _types(record: DriveRecord, found: Mapping[str, float]) -> list[str]:
    scenario = {each.route: each.scenario for each in record.routes}
    return [scenario[name] for name in found]


def _none(unit: str, reason: str) -> Estimate:
    return Estimate(Measure(None, unit, reason), None, None, 0)
