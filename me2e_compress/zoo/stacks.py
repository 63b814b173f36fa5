"""What the zoo holds: the face of every stack, without its torch code."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

from me2e_compress.errors import GraphError

Shape = tuple[int, ...]


@dataclass(frozen=True)
class ImageNorm:
    """How pixels become the image input: (pixel - mean) / std, channel by channel."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    order: str


@dataclass(frozen=True)
class Stack:
    """Inputs, outputs and conventions of a stack.

    Attributes:
        name: What the command line calls it.
        inputs: Shapes by input name, all float32.
        outputs: Names of the outputs, in order.
        recurrent: Output that answers each recurrent input.
        plan: Name of the output that is the plan.
        plan_deltas: The plan is metres a step, not positions.
        default_mode: Row of the plan that is driven without a command, by heads.
        image: How the image input is normalised.
    """

    name: str
    inputs: Mapping[str, Shape]
    outputs: tuple[str, ...]
    recurrent: Mapping[str, str]
    plan: str
    plan_deltas: bool
    default_mode: Mapping[str, int]
    image: ImageNorm

    def metadata(self, heads: str) -> dict[str, str]:
        """What the exported file says of itself, as ONNX metadata properties."""
        plan = {
            "output": self.plan,
            "deltas": self.plan_deltas,
            "command_input": None,
            "default_mode": self.default_mode[heads],
        }
        image = {
            "input": "img",
            "mean": self.image.mean,
            "std": self.image.std,
            "order": self.image.order,
        }
        return {
            "me2e.stack": self.name,
            "me2e.recurrent": json.dumps(dict(self.recurrent)),
            "me2e.plan": json.dumps(plan),
            "me2e.image": json.dumps(image),
        }


VAD_TINY = Stack(
    name="vad-tiny",
    inputs={
        "img": (1, 6, 3, 384, 640),
        "lidar2img": (1, 6, 4, 4),
        "can_bus": (18,),
        "prev_bev": (10000, 1, 256),
    },
    outputs=(
        "bev_embed",
        "all_cls_scores",
        "all_bbox_preds",
        "all_traj_preds",
        "all_traj_cls_scores",
        "map_all_cls_scores",
        "map_all_bbox_preds",
        "map_all_pts_preds",
        "ego_fut_preds",
    ),
    recurrent={"prev_bev": "bev_embed"},
    plan="ego_fut_preds",
    plan_deltas=True,
    default_mode={"nuscenes": 2, "bench2drive": 3},
    image=ImageNorm(
        mean=(123.675, 116.28, 103.53), std=(58.395, 57.12, 57.375), order="RGB"
    ),
)
"""hustvl/VAD, VAD_tiny_e2e.py: image statistics of ImageNet; commands right, left and
straight. Bench2DriveZoo: six road options, of which the fourth follows the lane."""

STACKS: dict[str, Stack] = {stack.name: stack for stack in (VAD_TINY,)}


def find(name: str) -> Stack:
    """The stack of that name.

    Raises:
        GraphError: There is none.
    """
    if name not in STACKS:
        raise GraphError(f"no stack {name!r} in the zoo: there is {', '.join(STACKS)}")
    return STACKS[name]
