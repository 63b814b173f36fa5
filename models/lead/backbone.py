"""Two residual networks, of the camera strip and of the raster, fused at each stage."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.lead.config import LeadConfig
from models.resnet import ResNet

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of channels from 0 to 1."""

UPSAMPLING = 2
"""Of the last map of the raster, before it is made a quarter of the raster's size."""
BEV_STRIDE = 4


class SelfAttention(nn.Module):
    """Attention over all tokens, with four linear layers of the same width."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.key, self.query = nn.Linear(width, width), nn.Linear(width, width)
        self.value, self.proj = nn.Linear(width, width), nn.Linear(width, width)
        self.heads = heads

    def forward(self, x: Tensor) -> Tensor:
        """Map tokens [1, T, C] to the same."""
        images, count, width = x.shape
        shape = images, count, self.heads, width // self.heads
        query, key, value = (
            layer(x).view(shape).transpose(1, 2)
            for layer in (self.query, self.key, self.value)
        )
        mixed = functional.scaled_dot_product_attention(query, key, value)
        out: Tensor = self.proj(mixed.transpose(1, 2).reshape(images, count, width))
        return out


class Block(nn.Module):
    """Attention and two linear layers, normalised before each (GPT-2's order)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.ln1, self.ln2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn = SelfAttention(width, heads)
        self.mlp = nn.Sequential(
            nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map tokens [1, T, C] to the same."""
        x = x + self.attn(self.ln1(x))
        out: Tensor = x + self.mlp(self.ln2(x))
        return out


class FusionTransformer(nn.Module):
    """Mixes the tokens of both maps."""

    def __init__(self, width: int, config: LeadConfig) -> None:
        super().__init__()
        tokens = math.prod(config.image_tokens) + math.prod(config.raster_tokens)
        self.pos_emb = nn.Parameter(torch.zeros(1, tokens, width))
        blocks = (
            Block(width, config.fusion_heads) for _ in range(config.fusion_layers)
        )
        self.blocks = nn.Sequential(*blocks)
        self.ln_f = nn.LayerNorm(width)

    def forward(self, image: Tensor, raster: Tensor) -> tuple[Tensor, Tensor]:
        """Map two maps of C channels, [1, C, h, w] each, to the same."""
        maps = image, raster
        tokens = [each.permute(0, 2, 3, 1).flatten(1, 2) for each in maps]
        mixed = self.ln_f(self.blocks(self.pos_emb + torch.cat(tokens, 1)))
        count = tokens[0].shape[1]
        parts = mixed[:, :count], mixed[:, count:]
        of_image, of_raster = (
            part.view(like.shape[0], *like.shape[2:], -1).permute(0, 3, 1, 2)
            for part, like in zip(parts, maps, strict=True)
        )
        return of_image, of_raster


class TransfuserBackbone(nn.Module):
    """ResNet-34 twice, with a fusion transformer after each of the four stages."""

    def __init__(self, config: LeadConfig) -> None:
        super().__init__()
        self.image_encoder = ResNet(config.stem, bottleneck=False)
        self.lidar_encoder = ResNet(config.stem, bottleneck=False, inputs=1)
        self.channels = self.image_encoder.channels
        # The fusion works in the channels of the strip
        self.avgpool_img = nn.AdaptiveAvgPool2d(config.image_tokens)
        self.avgpool_lidar = nn.AdaptiveAvgPool2d(config.raster_tokens)
        self.lidar_channel_to_img = nn.ModuleList(
            nn.Conv2d(width, width, 1) for width in self.channels
        )
        self.img_channel_to_lidar = nn.ModuleList(
            nn.Conv2d(width, width, 1) for width in self.channels
        )
        self.transformers = nn.ModuleList(
            FusionTransformer(width, config) for width in self.channels
        )
        # What the decoders of the bird's eye view read
        features = config.features
        self.c5_conv = nn.Conv2d(self.channels[-1], features, 1)
        self.up_conv5 = nn.Conv2d(features, features, 3, padding=1)
        self.up_conv4 = nn.Conv2d(features, features, 3, padding=1)
        rows, columns = config.raster_hw
        self.bev_hw = rows // BEV_STRIDE, columns // BEV_STRIDE

    def forward(self, rgb: Tensor, raster: Tensor) -> tuple[Tensor, Tensor]:
        """Return the last maps of the raster, [1, 512, 10, 12], and of the strip.

        Args:
            rgb: [1, 3, 384, 1152] float32, grey levels 0 to 255.
            raster: [1, 1, 320, 384] float32, 0 to 1.
        """
        image = self.image_encoder.stem(normalize(rgb))
        raster = self.lidar_encoder.stem(raster)
        for stage in range(len(self.channels)):
            image = self.image_encoder.get_submodule(f"layer{stage + 1}")(image)
            raster = self.lidar_encoder.get_submodule(f"layer{stage + 1}")(raster)
            image, raster = self._fused(image, raster, stage)
        return raster, image

    def _fused(
        self, image: Tensor, raster: Tensor, stage: int
    ) -> tuple[Tensor, Tensor]:
        """Add to each map what the fusion of both says of it."""
        tokens = self.lidar_channel_to_img[stage](self.avgpool_lidar(raster))
        of_image, of_raster = self.transformers[stage](self.avgpool_img(image), tokens)
        of_raster = self.img_channel_to_lidar[stage](of_raster)
        return image + enlarged(of_image, image), raster + enlarged(of_raster, raster)

    def top_down(self, raster: Tensor) -> Tensor:
        """Map the last map of the raster to [1, 64, 80, 96], a quarter of its size."""
        p5 = functional.relu(self.c5_conv(raster))
        twice = functional.interpolate(p5, scale_factor=UPSAMPLING, mode="bilinear")
        p4 = functional.relu(self.up_conv5(twice))
        wide = functional.interpolate(p4, size=self.bev_hw, mode="bilinear")
        return functional.relu(self.up_conv4(wide))


def enlarged(small: Tensor, like: Tensor) -> Tensor:
    """Enlarge a map to the rows and columns of another, fixed in a trace."""
    size = int(like.shape[2]), int(like.shape[3])
    return functional.interpolate(small, size=size, mode="bilinear")


def normalize(rgb: Tensor) -> Tensor:
    """Normalise channel by channel, in place of a copy.

    So does the original, and its exports hold what exporters make of that: Scatter.
    """
    out = rgb.clone()
    for at, (mean, std) in enumerate(zip(IMAGENET_MEAN, IMAGENET_STD, strict=True)):
        out[:, at] = (out[:, at] / 255.0 - mean) / std
    return out
