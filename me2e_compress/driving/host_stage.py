"""A stage behind the network, on the host: what it promises, and its names.

To add one: write its class, then add it to the table of names.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EvaluationError
from me2e_compress.registry import Registry

__all__ = ["HOST_STAGES", "HostStage", "HostWork"]


@dataclass(frozen=True, eq=False, slots=True)
class HostWork:
    """What a host stage made of a plan, and what it took.

    Attributes:
        plan: float64 [6, 2], as the policy contract has it; it drives.
        iterations: Of its solver; 0 where it had nothing to do.
        cells: Occupied cells that it took into account.
    """

    plan: npt.NDArray[np.float64]
    iterations: int = 0
    cells: int = 0


@dataclass(frozen=True)
class HostStage(abc.ABC):
    """Changes the plan on the host, when the network has run; its fields are options.

    Its time is part of the decision: a measured latency holds it, and
    `me2e_compress.driving.layered_latency.HostStageLatency` charges its iterations.

    Class attributes:
        name: What the command line and studies call it.
    """

    name: ClassVar[str]

    @abc.abstractmethod
    def work(
        self,
        plan: npt.NDArray[np.float64],
        outputs: Mapping[str, npt.NDArray[np.generic]],
    ) -> HostWork:
        """Return the plan that drives.

        Args:
            plan: [6, 2], of the network, metres in the ego frame; one of other times
                is read off at these.
            outputs: Of the network, by name.

        Raises:
            EvaluationError: The network lacks an output, or it has another form.
        """


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
