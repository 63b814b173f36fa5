"""VAD-tiny at its published size and in small: the same classes, layers and edges."""

from dataclasses import dataclass
from pathlib import Path

from models.bev.sizes import BevGrid, Sampling
from models.drawing import rendered
from models.export import GRID_SAMPLE_OPSET, build, export, save, trace
from models.stacks import VAD_TINY, Stack, vad_stack
from models.vad.config import PUBLISHED, RANGE, VadConfig
from models.vad.stack import VadTiny, initialise


@dataclass(frozen=True)
class VadSize:
    """How large it is.

    Attributes:
        name: Of `SIZES`.
        config: Its dimensions.
        stack: Its interface at these.
    """

    name: str
    config: VadConfig
    stack: Stack

    def build(self, sampling: Sampling = "operator") -> VadTiny:
        """Build and initialise it, seed 0, nuScenes heads."""
        model = VadTiny("nuscenes", sampling, self.config)
        images = rendered(self.stack, seed=0, stride=1)
        initialise(model.requires_grad_(False).eval(), images, seed=0)
        return model

    def export(self, path: Path, *, opset: int = 17, fused: bool = False) -> Path:
        """Build it anew and write it."""
        native: Sampling = "operator" if opset >= GRID_SAMPLE_OPSET else "gather"
        graph = trace(self.stack, self.build("fused" if fused else native), opset)
        return save(graph, self.stack.metadata(), path)


class PublishedSize(VadSize):
    """The stack by the functions that users call."""

    def build(self, sampling: Sampling = "operator") -> VadTiny:
        """Build it, of seed 0."""
        assert sampling == "operator"
        made = build("vad-tiny")
        assert isinstance(made, VadTiny)
        return made

    def export(self, path: Path, *, opset: int = 17, fused: bool = False) -> Path:
        """Export it, of seed 0."""
        return export("vad-tiny", path, opset=opset, fused=fused)


SMALL = VadConfig(
    image_hw=(96, 160),  # 0.1 of 900 x 1600, padded
    stem=8,
    grid=BevGrid((20, 20), RANGE, (20.0, 20.0)),
    agents=90,  # of six modes: attention of more than 512 tokens stays float
    vectors=10,
    vector_points=5,
)

SIZES = {
    size.name: size
    for size in (
        VadSize("small", SMALL, vad_stack(SMALL, scale=0.1)),
        PublishedSize("published", PUBLISHED, VAD_TINY),
    )
}
