"""TCP as a policy: driven by its control head, or by both heads as its agents do.

By its waypoints alone it drives through the adapter ``tcp`` that ships. The command
line takes a function of a module of your own that returns such a policy.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.contract import Observation, PedalsAndWheel, RouteInfo
from me2e_compress.driving.input_sources import Axes
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.runtime.frames import Array
from models.tcp.config import ActionHeads
from models.tcp.fusion import HeadFusion, Rule

OUTPUTS: Mapping[ActionHeads, tuple[str, ...]] = {
    "bench2drive": ("action_index",),
    "beta": ("mu_branches", "sigma_branches"),
}
"""Outputs of the control head."""

ACTIONS = (
    (0, 0, 1),
    *((0.7, steer, 0) for steer in (-0.5, -0.3, -0.2, -0.1, 0, 0.1, 0.2, 0.3, 0.5)),
    *((0.3, steer, 0) for steer in (-0.7, -0.5, -0.3, -0.2, -0.1, 0)),
    *((0.3, steer, 0) for steer in (0.1, 0.2, 0.3, 0.5, 0.7)),
    *((0, steer, 0) for steer in (-1, -0.6, -0.3, -0.1)),
    (1, 0, 0),
    *((0, steer, 0) for steer in (0.1, 0.3, 0.6, 1)),
    *((0.5, steer, 0) for steer in (-0.5, -0.3, -0.2, -0.1, 0, 0.1, 0.2, 0.3, 0.5)),
)
"""Throttle, steer and brake of Bench2DriveZoo's 39. The last nine have the reverse
gear, which its agent leaves out, as here."""


def best_action(scores: Array) -> PedalsAndWheel:
    """Return the action with the largest score, the first of equals."""
    row = _row(scores, "action_index", len(ACTIONS))
    if not np.isfinite(row).all():
        raise EvaluationError("a score of action_index is not finite")
    return PedalsAndWheel(*map(float, ACTIONS[int(np.argmax(row))]))


def likely_action(alphas: Array, betas: Array) -> PedalsAndWheel:
    """Return the modes of two Beta distributions: of acceleration, and of steer.

    As TCP's agent does: if both parameters are 1 or less there is no mode and the mean
    is taken; if one is, the mode is the end of the range on the other's side. An action
    of 0 to 1 is mapped to -1 to 1: full brake to full throttle, full left to full
    right.
    """
    rows = _row(alphas, "mu_branches", 2), _row(betas, "sigma_branches", 2)
    if not (np.minimum(*rows) >= 0).all() or np.isinf(rows[0] + rows[1]).any():
        said = " and ".join(str(row.tolist()) for row in rows)
        raise EvaluationError(f"{said} are no parameters of a Beta distribution")
    pairs = zip(*(row.tolist() for row in rows), strict=True)
    acceleration, steer = (2.0 * _mode(a, b) - 1.0 for a, b in pairs)
    return PedalsAndWheel(max(acceleration, 0.0), steer, max(0.0, -acceleration))


def _mode(alpha: float, beta: float) -> float:
    if max(alpha, beta) > 1.0:
        ahead, back = max(alpha - 1.0, 0.0), max(beta - 1.0, 0.0)
        return ahead / (ahead + back)
    # TCP's smallest sum: two zeros say nothing and give 0
    return alpha / max(alpha + beta, 1e-5)


def _row(output: Array, name: str, size: int) -> npt.NDArray[np.float64]:
    row = np.asarray(output, np.float64).reshape(-1)
    if len(row) != size:
        raise EvaluationError(f"{name} has {len(row)} numbers, it must have {size}")
    return row


@dataclass(frozen=True)
class TcpPolicy:
    """Runs an exported TCP, and reads its control head.

    Attributes:
        graph: The exported file; its plan is that of the trajectory head.
        heads: Which control head it has.
        fusion: Fuses both heads, with state of a route; None lets the control head
            drive.
    """

    graph: OnnxPolicy
    heads: ActionHeads
    fusion: HeadFusion | None
    needs_images: bool = field(default=True, init=False)
    privileged: bool = field(default=False, init=False)

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns in which the cameras are rendered."""
        return self.graph.image_size

    def reset(self, route: RouteInfo) -> None:
        """Begin a route."""
        self.graph.reset(route)
        if self.fusion is not None:
            self.fusion.reset()

    def plan(self, observation: Observation) -> PedalsAndWheel:
        """Return the controls, or both heads fused."""
        feeds = self.graph.inputs.feeds(observation)
        outputs = self.graph.session.run(feeds)
        if self.heads == "beta":
            control = likely_action(outputs["mu_branches"], outputs["sigma_branches"])
        else:
            control = best_action(outputs["action_index"])
        if self.fusion is None:
            return control
        plan = self.graph.trajectory(outputs, feeds, observation)
        if plan is None or observation.target_points is None:
            raise EvaluationError("fusion aims at a target point, and there is none")
        forward, left = observation.target_points[0].tolist()
        return self.fusion.fuse(plan, control, observation.speed_mps, (-left, forward))


def tcp_policy(model: Path, heads: ActionHeads, *, fused: bool) -> TcpPolicy:
    """Open an exported TCP, in the axes of its original's agent.

    Args:
        model: of `models.export`, with these heads.
        heads: ``bench2drive`` picks one of 39 actions, ``beta`` has distributions.
        fused: whether both heads drive, as the agent fuses them; else the control head.

    Raises:
        EvaluationError: The file cannot be run, or has other heads.
    """
    adapter = Adapter.load(adapter_file(Path("tcp")))
    if heads == "beta":
        adapter = adapter.model_copy(update={"axes": Axes.RIGHT_BACKWARD})
    graph = OnnxPolicy.open(model, adapter)
    for name in OUTPUTS[heads]:
        if name not in graph.session.outputs:
            raise EvaluationError(f"{model}: no output {name}: it has other heads")
    rule: Rule = "tcp" if heads == "beta" else "bench2drive"
    return TcpPolicy(graph, heads, HeadFusion(rule) if fused else None)
