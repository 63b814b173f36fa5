"""The stacks: inputs, outputs and conventions, without torch code."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from me2e_compress.base.errors import GraphError
from models.bev.sizes import CAMERAS, EMBED
from models.lead import config as lead
from models.uniad.config import CONFIGS, MEMORY, UniadConfig
from models.vad.config import VadConfig

Shape = tuple[int, ...]


@dataclass(frozen=True)
class ImageNorm:
    """How pixels become the image input: (pixel - mean) / std, per channel.

    Both are in grey levels 0 to 255, in the ``order`` of the model's channels.
    """

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    order: Literal["rgb", "bgr"]


IMAGENET = ImageNorm(
    mean=(123.675, 116.28, 103.53), std=(58.395, 57.12, 57.375), order="rgb"
)
"""Statistics of ImageNet in grey levels, as torchvision and mmdetection have them."""

CAFFE = ImageNorm(mean=(103.53, 116.28, 123.675), std=(1.0, 1.0, 1.0), order="bgr")
"""The same means in the form of Caffe's networks."""

GREY_LEVELS = ImageNorm(mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0), order="rgb")
"""Of a stack that normalises inside."""


@dataclass(frozen=True)
class Stack:
    """Inputs, outputs and conventions of a stack.

    Attributes:
        name: its name on the command line.
        inputs: shapes by input name.
        outputs: names of the outputs, in order.
        other_outputs: the same, of heads with other outputs.
        recurrent: the output that feeds each recurrent input.
        plan: name of the output that is the plan.
        plan_deltas: whether the plan is metres per step, not positions.
        plan_step_s: seconds between its waypoints, where they are not six every 0.5 s.
        heads: names of the last layers to choose from, the default first, each with the
            row of the plan that is driven without a command.
        image: normalisation of the image input.
        dtypes: element type of the inputs that are not float32.
        sees: the six cameras one by one, or three of them as one wide image, or that
            and a LiDAR.
        image_input: name of the image input.
        least_opset: the first that has all its operators.
        scale: relative to the cameras' 1600 x 900 images.
        straight_on: the command that follows the lane, for stacks with commands.
    """

    name: str
    inputs: Mapping[str, Shape]
    outputs: tuple[str, ...]
    recurrent: Mapping[str, str]
    plan: str
    plan_deltas: bool
    heads: Mapping[str, int]
    image: ImageNorm
    dtypes: Mapping[str, Literal["int64"]] = field(default_factory=dict)
    other_outputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    sees: Literal["surround", "strip", "strip and lidar"] = "surround"
    image_input: str = "img"
    least_opset: int = 13
    plan_step_s: float | None = None
    scale: float = 0.4
    straight_on: int = 0

    def with_heads(self, heads: str | None) -> "Stack":
        """Return the stack with only these heads; None is the default.

        Raises:
            GraphError: there are no heads of that name.
        """
        if heads is None:
            heads = next(iter(self.heads), None)
        if heads is None:
            return self
        if heads not in self.heads:
            raise GraphError(
                f"{self.name} has no heads {heads!r}: there is"
                f" {', '.join(self.heads) or 'nothing to choose'}"
            )
        outputs = self.other_outputs.get(heads, self.outputs)
        return replace(self, outputs=outputs, heads={heads: self.heads[heads]})

    def metadata(self) -> dict[str, str]:
        """Return the ONNX metadata properties that describe the exported file."""
        # Conventions of the plan
        plan: dict[str, object] = {
            "output": self.plan,
            "deltas": self.plan_deltas,
            "command_input": None,
            "default_mode": next(iter(self.heads.values()), 0),
        }
        if self.plan_step_s is not None:
            plan["step_s"] = self.plan_step_s
        # Conventions of the image input
        image = {
            "input": self.image_input,
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


def vad_stack(config: VadConfig, scale: float) -> Stack:
    """Return VAD-tiny's interface at the sizes of a configuration."""
    return Stack(
        name="vad-tiny",
        inputs={
            "img": (1, CAMERAS, 3, *config.image_hw),
            "lidar2img": (1, CAMERAS, 4, 4),
            "can_bus": (18,),
            "prev_bev": (config.grid.cells, 1, EMBED),
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
        heads={"nuscenes": 2, "bench2drive": 3},
        image=IMAGENET,
        scale=scale,
    )


VAD_TINY = vad_stack(VadConfig(), scale=0.4)
"""hustvl/VAD, VAD_tiny_e2e.py: image statistics of ImageNet; commands right, left and
straight. Bench2DriveZoo: six road options, of which the fourth follows the lane."""

HIGHWAY = Stack(
    name="highway",
    inputs={
        "img": (1, 6, 3, 96, 160),
        "lidar2img": (1, 6, 4, 4),
        "can_bus": (18,),
        "command": (1,),
        "timestamp": (1,),
        "prev_bev": (1, 768, 66),
        "prev_memory": (1, 2),
    },
    outputs=(
        "plan",
        "boxes",
        "scores",
        "futures",
        "route",
        "occupancy",
        "prev_bev_out",
        "prev_memory_out",
    ),
    recurrent={"prev_bev": "prev_bev_out", "prev_memory": "prev_memory_out"},
    plan="plan",
    plan_deltas=False,
    heads={},
    image=ImageNorm(mean=(110.0, 110.0, 110.0), std=(60.0, 60.0, 60.0), order="rgb"),
    dtypes={"command": "int64"},
)
"""The toolkit's own driver: the policy contract of highway-env, 32 x 24 cells of 64
channels and how well each is known, and two numbers of memory about the ego."""

TCP = Stack(
    name="tcp",
    inputs={"img": (1, 3, 256, 900), "state": (1, 9), "target_point": (1, 2)},
    outputs=("pred_wp", "action_index", "future_action_index"),
    recurrent={},
    plan="pred_wp",
    plan_deltas=False,
    heads={"bench2drive": 0, "beta": 0},
    image=IMAGENET,
    other_outputs={
        "beta": (
            "pred_wp",
            "mu_branches",
            "sigma_branches",
            "future_mu",
            "future_sigma",
        )
    },
    sees="strip",
    plan_step_s=0.5,
)
"""OpenDriveLab/TCP, whose control head gives Beta distributions, and Bench2DriveZoo,
branch tcp/admlp, where it scores 39 actions. Outputs are named as there."""


def lead_stack(name: str) -> Stack:
    """Return the interface of TransFuser v6 at the size of that name."""
    config = lead.CONFIGS[name]
    return Stack(
        name=name,
        inputs={
            "rgb": (1, 3, *config.image_hw),
            "rasterized_lidar": (1, 1, *config.raster_hw),
            "speed": (1,),
            "command": (1, lead.COMMANDS),
            **dict.fromkeys(lead.TARGET_POINTS, (1, 2)),
        },
        outputs=(
            "pred_route",
            "pred_future_waypoints",
            "pred_target_speed_distribution",
            "pred_target_speed_scalar",
            "pred_semantic",
            "pred_bev_semantic",
            "center_heatmap_pred",
            "wh_pred",
            "offset_pred",
            "yaw_class_pred",
            "yaw_res_pred",
            "velocity_pred",
        ),
        recurrent={},
        plan="pred_future_waypoints",
        plan_deltas=False,
        heads={},
        image=GREY_LEVELS,
        sees="strip and lidar",
        plan_step_s=lead.WAYPOINT_S,
        image_input="rgb",
        least_opset=14,
    )


LEAD, LEAD_TINY = (lead_stack(name) for name in lead.CONFIGS)
"""autonomousvision/lead, TransFuser v6, and the same small, for tests; inputs and
outputs are named as there. Attention of torch's own needs opset 14."""

UNIAD_COUNTS = ("obj_idxes", "disappear_time", "save_period", "max_obj_id")
UNIAD_OUTPUTS = (
    "all_cls_scores",
    "all_bbox_preds",
    "track_boxes",
    "track_scores",
    "track_labels",
    "lane_query",
    "lane_scores",
    "lane_boxes",
    "lane_masks",
    "traj_preds",
    "traj_scores",
    "occupancy",
    "sdc_traj",
)
"""Those that are not fed back."""


def uniad_stack(
    name: str, config: UniadConfig, scale: float, straight_on: int
) -> Stack:
    """Return UniAD-tiny's interface at the sizes of a configuration."""
    # Every recurrent input prev_X is fed by next_X
    state = _uniad_state(config.tracks)
    remembered = {f"prev_{key}": shape for key, shape in state.items()}
    counts = [key for key in remembered if key.endswith(UNIAD_COUNTS)]
    recurrent = {f"prev_{key}": f"next_{key}" for key in state}
    return Stack(
        name=name,
        inputs={
            "img": (1, CAMERAS, 3, *config.image_hw),
            "lidar2img": (1, CAMERAS, 4, 4),
            "can_bus": (18,),
            "command": (1,),
            "l2g_r_mat": (1, 3, 3),
            "l2g_t": (1, 3),
            "timestamp": (1,),
            "prev_bev": (config.grid.cells, 1, EMBED),
            **remembered,
        },
        outputs=("bev_embed", *recurrent.values(), *UNIAD_OUTPUTS),
        recurrent={"prev_bev": "bev_embed", **recurrent},
        plan="sdc_traj",
        plan_deltas=False,
        heads={},
        image=CAFFE,
        dtypes={"command": "int64", **dict.fromkeys(counts, "int64")},
        scale=scale,
        straight_on=straight_on,
    )


def _uniad_state(slots: int) -> dict[str, Shape]:
    """Return the shapes of the recurrent state, besides the bird's eye view."""
    return {
        "l2g_r_mat": (1, 3, 3),
        "l2g_t": (1, 3),
        "timestamp": (1,),
        "track_query": (slots, 2 * EMBED),
        "track_ref_pts": (slots, 3),
        "track_obj_idxes": (slots,),
        "track_disappear_time": (slots,),
        "track_save_period": (slots,),
        "track_velocity": (slots, 2),
        "track_mem_bank": (slots, MEMORY, EMBED),
        "track_mem_held": (slots, MEMORY),
        "max_obj_id": (1,),
    }


UNIAD_TINY = uniad_stack("uniad-tiny", CONFIGS["uniad-tiny"], 1.0, 3)
"""Bench2DriveZoo, tiny_e2e_b2d.py."""

UNIAD_TRT = uniad_stack("uniad-trt", CONFIGS["uniad-trt"], 0.25, 2)
"""NVIDIA/DL4AGX, uniad-trt: the tiny model of its TensorRT export, for nuScenes."""

STACKS: dict[str, Stack] = {
    stack.name: stack
    for stack in (VAD_TINY, UNIAD_TINY, UNIAD_TRT, TCP, LEAD, LEAD_TINY)
}
"""Those that are exported with weights of a seed or of a checkpoint."""


def find(name: str) -> Stack:
    """Return the stack of that name; an unknown name is a GraphError."""
    if name not in STACKS:
        raise GraphError(f"no stack {name!r}: there are {', '.join(STACKS)}")
    return STACKS[name]
