"""The interface of latency sources, what they know of a decision, and their names.

To add one: write its class, then add it to the table of names.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema

from me2e_compress.errors import EvaluationError
from me2e_compress.registry import Registry


@dataclass(frozen=True, eq=False, slots=True)
class DecisionFacts:
    """What a decision took here and what it saw, as the simulator tells it.

    Attributes:
        measured_us: Microseconds that it took on this machine.
        agents_m: float64 [N, 2], positions of other road users, occluded or not, metres
            in the ego frame, x forward, y left; None if the simulator does not tell.
        host_iterations: Solver iterations of a policy's host stage; 0 without one, or
            if it had nothing to do.
        host_cells: Occupied cells that the host stage took into account.
    """

    measured_us: int
    agents_m: npt.NDArray[np.float64] | None = None
    host_iterations: int = 0
    host_cells: int = 0


Charge = Callable[[DecisionFacts], int]
"""Maps the facts of a decision to the microseconds it takes on the vehicle."""


@dataclass(frozen=True)
class LatencySource(abc.ABC):
    """Says what each decision of a route costs; its fields are its options.

    An option of this type takes another source, or its text. ``measures`` is True if
    the source measures on this machine: such routes must run alone.
    """

    name: ClassVar[str]
    measures: ClassVar[bool] = False

    @abc.abstractmethod
    def on_route(self, route: str) -> Charge:
        """Return the clock of a route; it depends only on the route's name."""

    @abc.abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Return what decides the latencies, for the fingerprint of the results."""

    @property
    def measured(self) -> int | None:
        """The number of measurements that it draws from; None if it draws none."""
        return None

    @property
    def lacks_trace(self) -> bool:
        """Whether it stands for latencies that `with_trace` has yet to give."""
        return False

    def with_trace(self, samples_us: tuple[int, ...], scale: float) -> "LatencySource":
        """Return it with these samples (microseconds, in order) if it lacks them.

        ``scale`` multiplies them in addition to the source's own.
        """
        return self

    def __str__(self) -> str:
        """Return the text that `LATENCY_SOURCES` reads."""
        return LATENCY_SOURCES.text(self)

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Let an option that is any source take its text."""
        if cls is not LatencySource:
            return handler(source)
        return LATENCY_SOURCES.option_schema(LatencySource)


_HERE = "me2e_compress.driving.latency"
_LAYERED = "me2e_compress.driving.layered_latency"

LATENCY_SOURCES: Registry[LatencySource] = Registry(
    "latency source",
    "me2e_compress.latency_sources",
    EvaluationError,
    {
        "none": f"{_HERE}:NoLatency",
        "fps": f"{_HERE}:FrameRate",
        "fixed": f"{_HERE}:FixedLatency",
        "trace": f"{_HERE}:TraceLatency",
        "measured": f"{_HERE}:MeasuredLatency",
        "limited": f"{_LAYERED}:LimitedLatency",
        "agents": f"{_LAYERED}:AgentsLatency",
        "host-stage": f"{_LAYERED}:HostStageLatency",
    },
)


def check_positive(what: str, value: float) -> None:
    """Check an option of a latency source."""
    if not 0.0 < value < float("inf"):
        raise EvaluationError(f"latency {what} {value:g} is not a positive number")
