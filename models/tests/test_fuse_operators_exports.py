"""Deformable attention out of torch's two exporters, of real stacks and of others."""

import warnings
from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager, recipe
from me2e_compress.manager.report import Report
from me2e_compress.passes import Context

pytestmark = pytest.mark.slow

PASSES = "import-normalize,fold-constants,eliminate-redundant,fuse-operators"


def compressed(file: Path, passes: str = PASSES) -> Report:
    """Run the passes; each find is proven within 1e-4 or left."""
    manager = PassManager(recipe.parse(passes), verify_frames=0)
    return manager.run(graph.load(file), Context(ModuleMap.whole()))


def fused(model: ir.Model) -> list[ir.Node]:
    return [node for node in model.graph if node.domain == "me2e"]


def moves(model: ir.Model) -> list[str]:
    """List the operators that move what the fused nodes read and give."""
    makers = [
        value.producer() for node in fused(model) for value in node.inputs if value
    ]
    readers = [reader for node in fused(model) for reader, _ in node.outputs[0].uses()]
    return [
        node.op_type
        for node in (*makers, *readers)
        if node is not None and node.op_type in ("Transpose", "Concat")
    ]


def test_every_deformable_attention_of_vad_tiny(vad_tiny: Path) -> None:
    result = compressed(vad_tiny)
    # three encoder layers have two each, two decoders of three layers one a layer
    assert result.steps[-1].changes == len(fused(result.model)) == 12
    assert moves(result.model) == []


@pytest.mark.parametrize("dynamo", [False, True])
def test_both_exporters_of_torch(dynamo: bool, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnxscript")
    levels = ((6, 8), (3, 4))

    class Attention(torch.nn.Module):  # type: ignore[misc,name-defined]
        """Equation 3 of Deformable DETR, level by level."""

        def forward(self, value, locations, weights):  # type: ignore[no-untyped-def]
            images, _, heads, width = value.shape
            queries, points = locations.shape[1], locations.shape[4]
            parts = value.split([h * w for h, w in levels], dim=1)
            grids = 2 * locations - 1
            found = []
            for index, (h, w) in enumerate(levels):
                one = parts[index].flatten(2).transpose(1, 2)
                one = one.reshape(images * heads, width, h, w)
                grid = grids[:, :, :, index].transpose(1, 2).flatten(0, 1)
                found.append(
                    torch.nn.functional.grid_sample(
                        one, grid, padding_mode="zeros", align_corners=False
                    )
                )
            shape = (images * heads, 1, queries, len(levels) * points)
            spread = weights.transpose(1, 2).reshape(shape)
            total = (torch.stack(found, dim=-2).flatten(-2) * spread).sum(-1)
            return total.view(images, heads * width, queries).transpose(1, 2)

    shapes = ((2, 60, 4, 8), (2, 5, 4, 2, 3, 2), (2, 5, 4, 2, 3))
    inputs = tuple(torch.rand(shape) for shape in shapes)
    file = tmp_path / "attention.onnx"
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Attention().eval(), inputs, str(file), dynamo=dynamo, verbose=False,
            opset_version=18 if dynamo else 17,
        )  # fmt: skip
    result = compressed(file)
    assert result.steps[-1].changes == 1
    assert moves(result.model) == []
