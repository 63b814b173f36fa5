"""TCP of models/ with the branches that the original answers too (OpenDriveLab/TCP).

The stack leaves out what is used in training alone: the speed, the value of both
branches and the joint features, which the original's forward returns beside the
waypoints and the actions. Who exports that model gets all eight.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from models.drawing import draw_weights
from models.export import build, save, trace
from models.stacks import TCP
from models.tcp.stack import GAINS, Tcp

NAME = "tcp-original"
OF = "tcp"
"""The stack whose weights and frames it has."""
OPSET = 17
OUTPUTS = (
    *("pred_speed", "pred_value_traj", "pred_features_traj", "pred_wp"),
    *("pred_value_ctrl", "pred_features_ctrl", "action_index", "future_action_index"),
)


def export(path: Path, seed: int = 0) -> None:
    """Write the ONNX file, with the metadata of the stack's."""
    spec = dataclasses.replace(TCP.with_heads(None), outputs=OUTPUTS)
    made = build(OF, seed=seed)
    assert isinstance(made, Tcp)
    save(trace(spec, Branches(made, seed).eval(), OPSET), spec.metadata(), path)


class Branches(nn.Module):
    """The stack's network, and the branches behind what it computes on the way."""

    def __init__(self, model: Tcp, seed: int) -> None:
        super().__init__()
        self.model = model
        read = {
            "speed_branch": model.perception.fc,
            "value_branch_traj": model.join_traj,
            "value_branch_ctrl": model.join_ctrl,
        }
        self.seen: dict[str, Tensor] = {}
        for name, module in read.items():
            size = model.config.hidden
            width = size if module is not model.perception.fc else model.config.classes
            model.add_module(name, _branch(width, size, seed))
            module.register_forward_hook(self._keep(name))

    def _keep(self, name: str) -> Callable[[nn.Module, object, Tensor], None]:
        def keep(module: nn.Module, given: object, answer: Tensor) -> None:
            self.seen[name] = answer

        return keep

    def forward(self, img: Tensor, state: Tensor, target_point: Tensor) -> object:
        """Return all that the original's forward does, in its order."""
        waypoints, now, later = self.model(img, state, target_point)
        value = {
            name: self.model.get_submodule(name)(seen)
            for name, seen in self.seen.items()
        }
        traj, ctrl = (self.seen[f"value_branch_{each}"] for each in ("traj", "ctrl"))
        return (
            value["speed_branch"],
            *(value["value_branch_traj"], traj, waypoints),
            *(value["value_branch_ctrl"], ctrl, now, later),
        )


@torch.no_grad()
def _branch(width: int, size: int, seed: int) -> nn.Sequential:
    made = nn.Sequential(
        *(nn.Linear(width, size), nn.ReLU(), nn.Linear(size, size)),
        *(nn.Dropout(0.5), nn.ReLU(), nn.Linear(size, 1)),
    )
    draw_weights(made, GAINS, seed)
    return made
