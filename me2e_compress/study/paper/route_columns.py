"""Means over routes, and paired differences, of what a drive's record keeps."""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean

from me2e_compress.metrics.intervals import binomial_interval, bootstrap_interval
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.drive_record import DriveRecord, RouteRecord


@dataclass(frozen=True)
class RouteColumn:
    """One number of every route.

    Attributes:
        name: As it heads a table.
        unit: Of the number.
        of: Takes it from a route; None where it was not measured.
    """

    name: str
    unit: str
    of: Callable[[RouteRecord], float | None]


DS = RouteColumn("DS", "%", lambda route: route.driving_score)
SR = RouteColumn("SR %", "%", lambda route: 100.0 * route.succeeded)
DE = RouteColumn("DE %", "%", lambda route: route.efficiency)
DC = RouteColumn("DC", "ratio", lambda route: route.comfort)
COLUMNS = (DS, SR, DE, DC)


def mean_of(record: DriveRecord, column: RouteColumn, seed: int = 0) -> Estimate:
    """Return a mean over routes with its interval; a rate's is exact."""
    found = [each for route in record.routes if (each := column.of(route)) is not None]
    if not found:
        return _none(column.unit, f"no route has a {column.name}")
    mean = Measure(fmean(found), column.unit)
    if column is SR:
        low, high = binomial_interval(sum(each > 0 for each in found), len(found))
        ends = [None if each is None else 100.0 * each for each in (low, high)]
        return Estimate(mean, ends[0], ends[1], len(found))
    return Estimate(mean, *bootstrap_interval(found, seed), len(found))


def paired(
    record: DriveRecord,
    reference: DriveRecord,
    column: RouteColumn,
    seed: int = 0,
) -> Estimate:
    """Return the mean of "this minus the reference" over the routes that have both."""
    return mean_gap(gaps(record, reference, column), column, seed)


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


def mean_gap(found: dict[str, float], column: RouteColumn, seed: int = 0) -> Estimate:
    """Return the mean of differences with its interval."""
    unit = "points" if column.unit == "%" else column.unit
    if not found:
        return _none(unit, f"no route has a {column.name} in both drives")
    values = list(found.values())
    return Estimate(
        Measure(fmean(values), unit), *bootstrap_interval(values, seed), len(values)
    )


def _none(unit: str, reason: str) -> Estimate:
    return Estimate(Measure(None, unit, reason), None, None, 0)
