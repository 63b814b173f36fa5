"""Stages that run on the host after the network: their interface and their names.

To add one: write its class, then add it to the table of names.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema

from me2e_compress.errors import EvaluationError
from me2e_compress.registry import Registry

__all__ = ["HOST_STAGES", "HostStage", "HostWork"]


@dataclass(frozen=True, eq=False, slots=True)
class HostWork:
    """The plan [6, 2] that a host stage made, and the work it took.

    ``iterations`` of its solver are 0 if there was nothing to do; ``cells`` are the
    occupied cells taken into account.
    """

    plan: npt.NDArray[np.float64]
    iterations: int = 0
    cells: int = 0


@dataclass(frozen=True)
class HostStage(abc.ABC):
    """Changes the plan on the host after the network has run; its fields are options.

    A measured latency includes its time, and `HostStageLatency` of
    `me2e_compress.driving.layered_latency` charges its iterations.
    """

    name: ClassVar[str]

    @abc.abstractmethod
    def work(
        self,
        plan: npt.NDArray[np.float64],
        outputs: Mapping[str, npt.NDArray[np.generic]],
    ) -> HostWork:
        """Return the plan that drives, from the network's plan and outputs.

        The plan is [6, 2], metres in the ego frame, interpolated at the contract's
        times.

        Raises:
            EvaluationError: An output is missing or has another form.
        """

    def __str__(self) -> str:
        """Return the text that `HOST_STAGES` reads."""
        return HOST_STAGES.text(self)

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Let an option that is any host stage take its text."""
        if cls is not HostStage:
            return handler(source)
        return HOST_STAGES.option_schema(HostStage)


HOST_STAGES: Registry[HostStage] = Registry(
    "host stage",
    "me2e_compress.host_stages",
    EvaluationError,
    {
        "collision-optimizer": (
            "me2e_compress.driving.collision_optimizer:CollisionOptimizer"
        )
    },
)
