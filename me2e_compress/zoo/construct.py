"""Build the torch module of a stack, without weights."""

from typing import TYPE_CHECKING, cast

from me2e_compress.zoo.stacks import TCP, UNIADS, Stack

if TYPE_CHECKING:
    from torch import nn

    from me2e_compress.zoo.bev.sizes import Sampling
    from me2e_compress.zoo.tcp.config import ActionHeads
    from me2e_compress.zoo.vad.config import HeadsName


def construct(spec: Stack, sampling: "Sampling" = "operator") -> "nn.Module":
    """Build a module that the original's weights fit; its own are meaningless."""
    model: nn.Module
    if spec.name == TCP.name:
        from me2e_compress.zoo.tcp.stack import Tcp

        (heads,) = spec.heads
        model = Tcp(cast("ActionHeads", heads))
    elif spec.name in UNIADS:
        from me2e_compress.zoo.uniad.config import CONFIGS
        from me2e_compress.zoo.uniad.stack import UniadTiny

        model = UniadTiny(CONFIGS[spec.name], sampling, trained=True)
    else:
        from me2e_compress.zoo.vad.stack import VadTiny

        (heads,) = spec.heads
        model = VadTiny(cast("HeadsName", heads), sampling)
    return model.requires_grad_(False).eval()
