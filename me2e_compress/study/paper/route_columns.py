"""Means over routes, and paired differences, of what a drive's record keeps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from me2e_compress.metrics.intervals import Bounds, binomial_interval, mean_estimate
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.drive_record import DriveRecord, RouteRecord


@dataclass(frozen=True)
class RouteColumn:
    """One number of every route.

    Attributes:
        name: As it heads a table.
        unit: Of the number.
        of: Takes it from a route; None where it was not measured.
        bounds: Smallest and largest value of a route; None where there are none.
    """

    name: str
    unit: str
    of: Callable[[RouteRecord], float | None]
    bounds: Bounds | None = None


DS = RouteColumn("DS", "%", lambda route: route.driving_score, (0.0, 100.0))
SR = RouteColumn("SR %", "%", lambda route: 100.0 * route.succeeded, (0.0, 100.0))
DE = RouteColumn("DE %", "%", lambda route: route.efficiency)
DC = RouteColumn("DC", "ratio", lambda route: route.comfort, (0.0, 1.0))
COLUMNS = (DS, SR, DE, DC)


def mean_of(record: DriveRecord, column: RouteColumn, seed: int = 0) -> Estimate:
    """Return a mean over routes with its interval; a rate's is exact."""
    routes = [route for route in record.routes if column.of(route) is not None]
    found = [each for route in routes if (each := column.of(route)) is not None]
    if not found:
        return _none(column.unit, f"no route has a {column.name}")
    types = [route.scenario for route in routes]
    mean = mean_estimate(found, types, column.unit, seed, column.bounds)
    if column is SR:
        low, high = binomial_interval(sum(each > 0 for each in found), len(found))
        ends = [None if each is None else 100.0 * each for each in (low, high)]
        return replace(mean, low=ends[0], high=ends[1])
    return mean


def paired(
    record: DriveRecord,
    reference: DriveRecord,
    column: RouteColumn,
    seed: int = 0,
) -> Estimate:
    """Return the mean of "this minus the reference" over the routes that have both."""
    types = {route.route: route.scenario for route in record.routes}
    return mean_gap(gaps(record, reference, column), types, column, seed)


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
    types: Mapping[str, str],
    column: RouteColumn,
    seed: int = 0,
) -> Estimate:
    """Return the mean of differences with its intervals.

    Args:
        found: By route.
        types: Scenario type by route.
        column: What differs.
        seed: Of the bootstrap.
    """
    unit = "points" if column.unit == "%" else column.unit
    if not found:
        return _none(unit, f"no route has a {column.name} in both drives")
    bounds = None
    if column.bounds is not None:
        width = column.bounds[1] - column.bounds[0]
        bounds = -width, width
    kinds = [types[route] for route in found]
    return mean_estimate(list(found.values()), kinds, unit, seed, bounds)


def _none(unit: str, reason: str) -> Estimate:
    return Estimate(Measure(None, unit, reason), None, None, 0)
