"""What a latency source promises, and what it is told of a decision.

To add one: write its class, then add it to the table of names.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from me2e_compress.errors import EvaluationError
from me2e_compress.registry import Registry


@dataclass(frozen=True, eq=False, slots=True)
class DecisionFacts:
    """What a decision took here and what it saw: a simulator tells, no model is asked.

    Attributes:
        measured_us: Microseconds that it took on this machine.
        agents_m: float64 [N, 2], where other road users are, whatever hides them:
            metres in the ego frame, x forward, y left; None where nobody tells.
        host_iterations: Of the solver of a policy's host stage; 0 without one, or
            where it had nothing to do.
        host_cells: Occupied cells that the host stage took into account.
    """

    measured_us: int
    agents_m: npt.NDArray[np.float64] | None = None
    host_iterations: int = 0
    host_cells: int = 0


Charge = Callable[[DecisionFacts], int]
"""From what is known of a decision to the microseconds it takes on the vehicle."""


@dataclass(frozen=True)
class LatencySource(abc.ABC):
    """Says what each decision of a route costs; its fields are its options.

    An option of this type takes another source, or its text.

    Class attributes:
        name: What the command line and studies call it.
        measures: True if it depends on this machine, now: such routes must run alone.
    """

    name: ClassVar[str]
    measures: ClassVar[bool] = False

    @abc.abstractmethod
    def on_route(self, route: str) -> Charge:
        """Return the clock of one route; it depends on nothing but its identity."""

    @abc.abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Return what decides the latencies, for the fingerprint of the results."""

    @property
    def measured(self) -> int | None:
        """How many measurements its latencies are drawn from; None: it draws none."""
        return None

    @property
    def lacks_trace(self) -> bool:
        """Whether it stands for latencies that `with_trace` has yet to give."""
        return False

    def with_trace(self, samples_us: tuple[int, ...], scale: float) -> "LatencySource":
        """Return it with these latencies where it lacks them; else itself.

        Args:
            samples_us: Microseconds, in the order of the recording.
            scale: What they are multiplied by, beside its own.
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
        return core_schema.no_info_before_validator_function(
            _source_of, core_schema.is_instance_schema(LatencySource)
        )


def _source_of(given: object) -> object:
    return LATENCY_SOURCES.parse(given) if isinstance(given, str) else given


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
    """Check an option of a latency source.

    Raises:
        EvaluationError: It is not a positive number.
    """
    if not 0.0 < value < float("inf"):
        raise EvaluationError(f"latency {what} {value:g} is not a positive number")
