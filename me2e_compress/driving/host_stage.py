"""Stages that run on the host after the network: interface, names, and UniAD's.

To add one: write its class, then add it to the table of names.
"""

import abc
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.registry import Registry
from me2e_compress.driving.contract import Positive

Floats = npt.NDArray[np.float64]
UNIAD_CELL_M = 0.5  # side of a cell of UniAD's occupancy, as its weight assumes


@dataclass(frozen=True, eq=False, slots=True)
class HostWork:
    """The plan that a host stage made, and the work it took."""

    plan: npt.NDArray[np.float64]  # (6, 2) metres in the ego frame
    iterations: int = 0  # of its solver; 0 if there was nothing to do
    cells: int = 0  # occupied cells taken into account


@dataclass(frozen=True)
class HostStage(abc.ABC):
    """Changes the plan on the host after the network has run; its fields are options.

    A measured latency includes its time, and `HostStageLatency` of
    `me2e_compress.driving.latency` charges its iterations.
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
    {"collision-optimizer": ("me2e_compress.driving.host_stage:CollisionOptimizer")},
)


@dataclass(frozen=True)
class CollisionOptimizer(HostStage):
    """Keeps the plan near itself and away from cells that will be occupied.

    It runs only if cells near the plan are occupied: in critical frames alone, which
    makes the tail of UniAD's latency.

    UniAD's ``CollisionNonlinearOptimizer`` (OpenDriveLab/UniAD, planning head): over
    the six waypoints p, with the network's waypoints r, the occupied cells o within a
    radius of r at the same time and the sigma s, it minimises ::

        sum |p - r|^2 + weight * sum exp(-|p - o|^2 / (2 s^2)) / (sqrt(2 pi) s)

    starting at r. UniAD builds it in CasADi and solves it with IPOPT; here SciPy solves
    it with its exact gradient: the same minimum in a fraction of the time. So a latency
    for UniAD's is charged by iterations and cells rather than measured.

    Attributes:
        output: The network's occupancy output: probabilities [1, T, rows, columns] that
            a cell is occupied when waypoint t is reached (later waypoints take the
            last), the first row farthest ahead, the first column farthest left.
        front_m: x of the outer edge of the first row, ego frame; that of ``highway``.
        left_m: y of the outer edge of the first column.
        cell_m: Side of a cell.
        threshold: Probability above which a cell is occupied; ours.
        radius_m: From the waypoint to the centre of a cell that counts; UniAD's.
        sigma_m: Width of a cell's repulsion; UniAD's.
        weight: Weight of a cell of 0.5 m, as UniAD's is; other cells weigh by their
            area.
        solver: SciPy's method; ``SLSQP`` is faster, mostly by a little, sometimes by
            far: ``benchmarks/measure/host_stage.py``.
    """

    name: ClassVar[str] = "collision-optimizer"
    output: str = "occupancy"
    front_m: float = 48.0
    left_m: float = 24.0
    cell_m: Positive = 1.0
    threshold: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.5
    radius_m: Positive = 5.0
    sigma_m: Positive = 1.0
    weight: Positive = 5.0
    solver: Literal["SLSQP", "L-BFGS-B"] = "SLSQP"

    def work(
        self, plan: Floats, outputs: Mapping[str, npt.NDArray[np.generic]]
    ) -> HostWork:
        """Return the plan moved off occupied cells; the same plan if none are near."""
        from scipy.optimize import minimize  # takes a second to import

        # Check the network's output
        occupancy = outputs.get(self.output)
        if occupancy is None:
            raise EvaluationError(
                f"{self.name}: the model has no output {self.output}; there are "
                f"{', '.join(outputs)}"
            )
        if occupancy.ndim != 4 or occupancy.shape[0] != 1 or not occupancy.size:
            raise EvaluationError(
                f"{self.name}: output {self.output} has shape {list(occupancy.shape)},"
                " it must be [1, T, rows, columns]"
            )
        cells, step = self.near(plan, np.asarray(occupancy[0], np.float64))
        if not len(cells):
            return HostWork(plan)
        # Minimise from the network's plan on; UniAD's weight is of its own cells
        reference = np.asarray(plan, np.float64)
        weight = self.weight * (self.cell_m / UNIAD_CELL_M) ** 2
        problem, how = (reference, cells, step, self.sigma_m, weight), self.solver
        solution = minimize(cost, reference.ravel(), problem, how, jac=True)
        plan = solution.x.reshape(reference.shape)
        return HostWork(plan, int(solution.nit), len(cells))

    def near(
        self, plan: Floats, occupancy: Floats
    ) -> tuple[Floats, npt.NDArray[np.intp]]:
        """Return the occupied cells [N, 2] near their waypoint, and its index [N]."""
        # plan is (6, 2) in the ego frame, occupancy (T, rows, columns); a cell of time
        # t is compared with waypoint t
        # occupied cells at the time of each waypoint, the last one repeated
        times = np.minimum(np.arange(len(plan)), len(occupancy) - 1)
        step, row, column = np.nonzero(occupancy[times] > self.threshold)
        # centres of the cells
        x = self.front_m - self.cell_m * (row + 0.5)
        y = self.left_m - self.cell_m * (column + 0.5)
        cells = np.stack([x, y], axis=-1).astype(np.float64)
        near = np.hypot(*(cells - plan[step]).T) <= self.radius_m
        return cells[near], step[near]


def cost(
    flat: Floats,
    reference: Floats,
    cells: Floats,
    step: npt.NDArray[np.intp],
    sigma: float,
    weight: float,
) -> tuple[float, Floats]:
    """Return the objective of waypoints [12], and its gradient [12].

    ``reference`` is [6, 2], ``step`` [N] the waypoint that each of the cells [N, 2] is
    near, ``weight`` that of one cell.
    """
    waypoints = flat.reshape(reference.shape)
    # Of sum |p - r|^2 + sum height exp(-|p - o|^2 / (2 s^2)), by p
    moved, away = waypoints - reference, waypoints[step] - cells
    height = weight / (math.sqrt(2.0 * math.pi) * sigma)
    hills = height * np.exp(-(away**2).sum(axis=1) / (2.0 * sigma**2))
    gradient = 2.0 * moved
    np.add.at(gradient, step, -hills[:, None] * away / sigma**2)
    return float((moved**2).sum() + hills.sum()), gradient.ravel()
