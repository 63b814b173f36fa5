"""The torch module of a stack, before it has weights."""

from typing import TYPE_CHECKING, cast

from me2e_compress.zoo.stacks import TCP, Stack

if TYPE_CHECKING:
    from torch import nn

    from me2e_compress.zoo.bev.sizes import Sampling
    from me2e_compress.zoo.tcp.config import ActionHeads
    from me2e_compress.zoo.vad.config import HeadsName


def construct(spec: Stack, sampling: "Sampling" = "operator") -> "nn.Module":
    """Build the module of a stack with its only heads; its weights mean nothing yet.

    Args:
        spec: Of `Stack.with_heads`.
        sampling: How features are sampled, of a stack that samples any.
    """
    (heads,) = spec.heads
    model: nn.Module
    if spec.name == TCP.name:
        from me2e_compress.zoo.tcp.stack import Tcp

        model = Tcp(cast("ActionHeads", heads))
    else:
        from me2e_compress.zoo.vad.stack import VadTiny

        model = VadTiny(cast("HeadsName", heads), sampling)
    return model.requires_grad_(False).eval()
