"""The paper's scores of a route, as they stand in drive records."""

from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_values import RouteColumn
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.route_summary import RouteSummary

Column = RouteColumn[RouteSummary]

DS = Column("DS", "%", lambda route: route.driving_score, (0.0, 100.0))
SR = Column("SR %", "%", lambda route: 100.0 * route.succeeded, (0.0, 100.0))
DE = Column("DE %", "%", lambda route: route.efficiency)
DC = Column("DC", "ratio", lambda route: route.comfort, (0.0, 1.0))
COLUMNS = (DS, SR, DE, DC)


def mean_of(record: DriveRecord, column: Column, seed: int = 0) -> Estimate:
    """Return a mean over routes with its intervals."""
    return column.values(record.routes).mean(seed)


def paired(
    record: DriveRecord, reference: DriveRecord, column: Column, seed: int = 0
) -> Estimate:
    """Return the mean of "this minus the reference" over the routes that have both."""
    gaps = column.values(record.routes) - column.values(reference.routes)
    return gaps.mean(seed)
