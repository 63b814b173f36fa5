"""A feature pyramid over several stages."""

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional

from models.bev.sizes import EMBED


class ConvModule(nn.Module):
    """A convolution under the name that the published weights use."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, stride, kernel // 2)

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, C, H, W] to [N, out, H / stride, W / stride]."""
        out: Tensor = self.conv(x)
        return out


class FeaturePyramid(nn.Module):
    """Stages, the finest first, to 256 channels each, and ``extra`` levels on top.

    Lin et al. 2017. ``hws`` are the rows and columns of several stages: without them
    the exporter would write shape arithmetic.
    """

    def __init__(
        self,
        channels: Sequence[int],
        extra: int = 0,
        hws: Sequence[tuple[int, int]] = (),
    ) -> None:
        super().__init__()
        self.hws = tuple(hws)
        self.lateral_convs = nn.ModuleList(ConvModule(c, EMBED, 1) for c in channels)
        self.fpn_convs = nn.ModuleList(ConvModule(EMBED, EMBED, 3) for _ in channels)
        self.fpn_convs.extend(ConvModule(EMBED, EMBED, 3, 2) for _ in range(extra))

    def forward(self, stages: Sequence[Tensor]) -> list[Tensor]:
        """Map the stages [N, C, h, w] to the levels [N, 256, h, w]."""
        maps = [conv(x) for conv, x in zip(self.lateral_convs, stages, strict=True)]
        for finer in range(len(maps) - 2, -1, -1):
            size = list(self.hws[finer])
            enlarged = functional.interpolate(maps[finer + 1], size, mode="nearest")
            maps[finer] = maps[finer] + enlarged
        levels = [conv(x) for conv, x in zip(self.fpn_convs, maps, strict=False)]
        for conv in self.fpn_convs[len(maps) :]:
            levels.append(conv(levels[-1]))
        return levels
