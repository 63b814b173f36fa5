"""TCP in small: the same classes, fewer pixels and channels."""

import dataclasses

import torch

from models.stacks import TCP, Stack
from models.tcp.config import ActionHeads, TcpConfig
from models.tcp.stack import Tcp, initialise

SMALL = TcpConfig(
    image_hw=(64, 96), stem=8, classes=20, measured=8, joint=24, hidden=16
)


def small_spec(heads: ActionHeads) -> Stack:
    inputs = {**TCP.inputs, "img": (1, 3, *SMALL.image_hw)}
    return dataclasses.replace(TCP.with_heads(heads), inputs=inputs)


def small_tcp(heads: ActionHeads) -> Tcp:
    model = Tcp(heads, config=SMALL).requires_grad_(False).eval()
    noise = torch.Generator().manual_seed(0)
    images = torch.randn(4, 3, *SMALL.image_hw, generator=noise)
    initialise(model, images, seed=0)
    return model
