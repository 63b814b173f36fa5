"""Weights for more levels than there are, read as mmcv's kernel reads them."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from models.bev.attention import DecoderAttention

HW = (3, 5)
HEADS, LEVELS, POINTS = 8, 4, 4


def kernel(value: Tensor, locations: Tensor, weights: Tensor) -> Tensor:
    """``ms_deformable_im2col_gpu_kernel`` for one level, entry by entry.

    Args:
        value: [cells, heads, 32].
        locations: Flat, of [Q, heads, 4, 4, 2].
        weights: Flat, of [Q, heads, 4, 4].
    """
    queries = weights.numel() // (HEADS * LEVELS * POINTS)
    out = torch.zeros(queries, HEADS, value.shape[2])
    for index in range(queries * HEADS):
        query, head = divmod(index, HEADS)
        image = value[:, head].T.reshape(1, -1, *HW)
        for point in range(index * POINTS, (index + 1) * POINTS):
            at = 2 * locations[2 * point : 2 * point + 2].view(1, 1, 1, 2) - 1
            seen = functional.grid_sample(image, at, align_corners=False)
            out[query, head] += weights[point] * seen.flatten()
    return out


@pytest.fixture
def attention() -> DecoderAttention:
    torch.manual_seed(0)
    made = DecoderAttention(HW, "operator", held=LEVELS, boxes=True)
    for each in made.parameters():
        each.copy_(0.05 * torch.randn(each.shape))
    return made


@pytest.fixture(autouse=True)
def _no_gradients() -> object:
    with torch.no_grad():
        yield


def drawn(queries: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    torch.manual_seed(1)
    query, pos = torch.randn(2, 1, queries, 256)
    return query, pos, torch.randn(1, HW[0] * HW[1], 256), torch.rand(1, queries, 4)


@pytest.mark.parametrize("queries", [8, 7])
def test_samples_are_where_the_kernel_takes_them(
    attention: DecoderAttention, queries: int
) -> None:
    query, pos, bev, at = drawn(queries)
    asked = (query + pos)[0]
    offsets = attention.sampling_offsets(asked).view(queries, HEADS, LEVELS, POINTS, 2)
    boxes = at[0, :, None, None, None]
    locations = boxes[..., :2] + offsets / POINTS * boxes[..., 2:] * 0.5
    weights = attention.attention_weights(asked).view(queries, HEADS, -1).softmax(-1)
    value = attention.value_proj(bev)[0].view(-1, HEADS, 32)
    read = kernel(value, locations.flatten(), weights.flatten()).flatten(1)
    want = query[0] + attention.output_proj(read)

    got = attention(query, pos, bev, at)[0]

    torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore")  # of the exporter
def test_onnxruntime_agrees(attention: DecoderAttention, tmp_path: Path) -> None:
    inputs, names = drawn(8), ["query", "pos", "bev", "at"]
    file = tmp_path / "a.onnx"
    torch.onnx.export(
        attention, inputs, file, dynamo=False, opset_version=17, input_names=names
    )
    session = onnxruntime.InferenceSession(file)
    feed = {name: each.numpy() for name, each in zip(names, inputs, strict=True)}
    (got,) = session.run(None, feed)
    np.testing.assert_allclose(
        np.asarray(got), attention(*inputs), rtol=1e-4, atol=1e-4
    )
