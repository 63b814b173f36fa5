"""Build the torch module of a stack, without weights or with those of a seed."""

from typing import TYPE_CHECKING, Any, cast

from models.lead.config import CONFIGS as LEAD_CONFIGS
from models.stacks import TCP, Stack
from models.synthetic_frames import frames
from models.uniad.config import CONFIGS

if TYPE_CHECKING:
    from torch import nn

    from models.bev.sizes import Sampling
    from models.tcp.config import ActionHeads
    from models.vad.config import HeadsName


def construct(
    spec: Stack, sampling: "Sampling" = "operator", *, trained: bool = True
) -> "nn.Module":
    """Build a module whose weights are meaningless; those of the original fit it.

    ``trained`` False leaves out what only the original's weights need.
    """
    model: nn.Module
    if spec.name == TCP.name:
        from models.tcp.stack import Tcp

        (heads,) = spec.heads
        model = Tcp(cast("ActionHeads", heads))
    elif spec.name in LEAD_CONFIGS:
        from models.lead.stack import TransfuserV6

        model = TransfuserV6(LEAD_CONFIGS[spec.name])
    elif spec.name in CONFIGS:
        from models.uniad.stack import UniadTiny

        model = UniadTiny(CONFIGS[spec.name], sampling, trained=trained)
    else:
        from models.vad.stack import VadTiny

        (heads,) = spec.heads
        model = VadTiny(cast("HeadsName", heads), sampling)
    return model.requires_grad_(False).eval()


def draw(spec: Stack, sampling: "Sampling", seed: int) -> "nn.Module":
    """Build a module with weights of a seed; the same seed gives the same bytes."""
    import torch

    from models.drawing import rendered, rendered_inputs

    model: Any = construct(spec, sampling, trained=False)  # one of four classes
    if spec.name == TCP.name:
        from models.tcp import stack as tcp

        tcp.initialise(model, rendered(spec, seed), seed)
    elif spec.name in LEAD_CONFIGS:
        from models.lead import stack as lead

        names = "rgb", "rasterized_lidar"
        images, rasters = rendered_inputs(spec, names, seed, stride=1)
        lead.initialise(model, images, rasters, seed)
    elif spec.name in CONFIGS:
        from models.uniad import initialise as uniad

        (frame,) = frames(spec, 1, seed)
        images, cameras = (torch.from_numpy(frame[n]) for n in ("img", "lidar2img"))
        uniad.initialise(model, images[0], cameras, seed)
    else:
        from models.vad import stack as vad

        vad.initialise(model, rendered(spec, seed), seed)
    drawn: nn.Module = model
    return drawn
