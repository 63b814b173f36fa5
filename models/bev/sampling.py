"""Sample a feature map at fractional positions."""

import functools
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from models.bev.sizes import Sampling


def sample(
    image: Tensor,
    grid: Tensor,
    sampling: Sampling,
    mode: Literal["bilinear", "nearest"] = "bilinear",
) -> Tensor:
    """Sample an image [N, C, H, W] at positions [N, Q, P, 2]; return [N, C, Q, P].

    All are float32. Positions are x then y, -1 and 1 the outer edges; outside is zero.
    ``operator`` uses grid_sample (ONNX opset 16 and later), the other samplings write
    the same in operators of opset 13.
    """
    if sampling == "operator":
        return functional.grid_sample(
            image, grid, mode=mode, padding_mode="zeros", align_corners=False
        )
    # Pixels as rows
    batch, channels, height, width = image.shape
    rows = image.flatten(2).transpose(1, 2).reshape(-1, channels)
    start = (torch.arange(batch) * (height * width)).view(-1, 1, 1)
    x = ((grid[..., 0] + 1) * width - 1) / 2
    y = ((grid[..., 1] + 1) * height - 1) / 2
    # Corners around each position, with their shares
    if mode == "nearest":
        corners = [(torch.round(x), torch.round(y), torch.ones_like(x))]
    else:
        left, top = torch.floor(x), torch.floor(y)
        right_part, bottom_part = x - left, y - top
        corners = [
            (left, top, (1 - right_part) * (1 - bottom_part)),
            (left + 1, top, right_part * (1 - bottom_part)),
            (left, top + 1, (1 - right_part) * bottom_part),
            (left + 1, top + 1, right_part * bottom_part),
        ]
    # Corners outside of the image have no share
    parts = []
    for column, row, weight in corners:
        inner_column = column.clamp(0, width - 1)
        inner_row = row.clamp(0, height - 1)
        inside = (inner_column == column) & (inner_row == row)
        index = start + (inner_row * width + inner_column).to(torch.int64)
        weight = weight * inside.to(weight.dtype)
        parts.append(rows[index] * weight.unsqueeze(-1))
    return functools.reduce(torch.add, parts).permute(0, 3, 1, 2)
