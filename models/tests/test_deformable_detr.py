"""Every deformable attention of a Deformable DETR, as torch exports it.

The layers are written out after transformers' ``modeling_deformable_detr.py``, with its
projections, its mask and both kinds of reference points, so that no target needs that.
"""

import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from models.tests.test_fuse_operators_exports import PASSES, compressed, fused, moves

LEVELS = ((12, 16), (6, 8), (3, 4))
PIXELS = sum(height * width for height, width in LEVELS)
WIDTH, HEADS, POINTS, QUERIES = 64, 8, 4, 20


class DeformableAttention(nn.Module):
    """Equation 3 of Zhu et al., 2021, with all that its layer projects."""

    def __init__(self) -> None:
        super().__init__()
        samples = HEADS * len(LEVELS) * POINTS
        self.value = nn.Linear(WIDTH, WIDTH)
        self.offsets = nn.Linear(WIDTH, 2 * samples)
        self.shares = nn.Linear(WIDTH, samples)
        self.output = nn.Linear(WIDTH, WIDTH)

    def forward(
        self, query: Tensor, memory: Tensor, seen: Tensor, at: Tensor
    ) -> Tensor:
        """Attend from queries [n, q, c] to pixels [n, p, c], at [n, q, levels, 2 or 4].

        ``seen`` [n, p] is false where an image was padded.
        """
        images, queries, _ = query.shape
        value = self.value(memory).masked_fill(~seen[..., None], 0.0)
        value = value.view(images, PIXELS, HEADS, WIDTH // HEADS)
        form = (images, queries, HEADS, len(LEVELS), POINTS)
        offsets = self.offsets(query).view(*form, 2)
        shares = self.shares(query).view(images, queries, HEADS, -1).softmax(-1)
        if at.shape[-1] == 2:
            sizes = torch.tensor([[width, height] for height, width in LEVELS])
            steps = offsets / sizes[None, None, None, :, None, :]
            places = at[:, :, None, :, None, :] + steps
        else:
            boxes = at[:, :, None, :, None, :]
            places = boxes[..., :2] + offsets / POINTS * boxes[..., 2:] * 0.5
        found: Tensor = self.output(sampled(value, places, shares.view(form)))
        return found


def sampled(value: Tensor, places: Tensor, shares: Tensor) -> Tensor:
    """Sample level by level, and weigh."""
    images, queries = places.shape[:2]
    parts = value.split([height * width for height, width in LEVELS], dim=1)
    grids, found = 2 * places - 1, []
    for level, (height, width) in enumerate(LEVELS):
        one = parts[level].flatten(2).transpose(1, 2)
        one = one.reshape(images * HEADS, WIDTH // HEADS, height, width)
        grid = grids[:, :, :, level].transpose(1, 2).flatten(0, 1)
        found.append(
            nn.functional.grid_sample(
                one, grid, mode="bilinear", padding_mode="zeros", align_corners=False
            )
        )
    weights = shares.transpose(1, 2).reshape(images * HEADS, 1, queries, -1)
    total = (torch.stack(found, dim=-2).flatten(-2) * weights).sum(-1)
    return total.view(images, WIDTH, queries).transpose(1, 2).contiguous()


class Transformer(nn.Module):
    """Two layers of the encoder; one of the decoder at points, two at boxes."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.ModuleList(DeformableAttention() for _ in range(2))
        self.decoder = nn.ModuleList(DeformableAttention() for _ in range(3))
        self.norms = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(5))
        self.queries = nn.Parameter(torch.randn(1, QUERIES, WIDTH))
        self.points = nn.Linear(WIDTH, 2)
        self.boxes = nn.Linear(WIDTH, 4)

    def forward(self, pixels: Tensor, seen: Tensor) -> Tensor:
        centres = [
            torch.stack(
                torch.meshgrid(
                    (torch.arange(width) + 0.5) / width,
                    (torch.arange(height) + 0.5) / height,
                    indexing="xy",
                ),
                dim=-1,
            ).reshape(-1, 2)
            for height, width in LEVELS
        ]
        own = torch.cat(centres)[None, :, None, :].expand(1, -1, len(LEVELS), -1)
        for layer, norm in zip(self.encoder, self.norms, strict=False):
            pixels = norm(pixels + layer(pixels, pixels, seen, own))
        query = self.queries
        for index, layer in enumerate(self.decoder):
            refer = self.boxes if index else self.points
            at = refer(query).sigmoid()[:, :, None].expand(-1, -1, len(LEVELS), -1)
            query = self.norms[2 + index](query + layer(query, pixels, seen, at))
        return query


def test_every_deformable_attention_of_deformable_detr(tmp_path: Path) -> None:
    file = tmp_path / "detr.onnx"
    seen = torch.arange(PIXELS)[None] % 16 < 14
    torch.manual_seed(0)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Transformer().eval(), (torch.randn(1, PIXELS, WIDTH), seen), str(file),
            opset_version=17, dynamo=False,
            input_names=["pixels", "seen"], output_names=["found"],
        )  # fmt: skip

    result = compressed(file, f"{PASSES},eliminate-redundant,fold-constants")

    assert result.steps[-3].changes == len(fused(result.model)) == 2 + 3
    assert moves(result.model) == []
