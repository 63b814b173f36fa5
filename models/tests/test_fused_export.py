"""Stacks exported with deformable attention as one node, in every dialect."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from me2e_compress import graph
from me2e_compress.base.errors import RecipeError
from me2e_compress.operators import expand, find, fused_nodes, import_domains
from me2e_compress.operators.deformable_attention import DeformableAttention
from models.bev.attention import DecoderAttention
from models.dialect import in_dialect
from models.export import ExportOptions, trace
from models.stacks import VAD_TINY
from models.synthetic_frames import Frame
from models.tests.vad.sizes import VadSize
from models.vad.stack import VadTiny
from tests.operators.running import run

DIALECTS = [each.name for each in DeformableAttention().all_dialects()]
QUERIES = (1, 5, 256)
SHAPES = {"query": QUERIES, "pos": QUERIES, "bev": (1, 12, 256), "at": (1, 5, 2)}
SMALL = replace(VAD_TINY, name="small", inputs=SHAPES, outputs=("read",), dtypes={})


@pytest.fixture(scope="module")
def layer() -> nn.Module:
    torch.manual_seed(0)
    return DecoderAttention((3, 4), "fused").requires_grad_(False).eval()


@pytest.fixture(scope="module", params=[13, 17])
def traced(request: pytest.FixtureRequest, layer: nn.Module) -> onnx.ModelProto:
    return trace(SMALL, layer, request.param)


def expanded(model: ir.Model) -> ir.Model:
    for fused in fused_nodes(model):
        expand(fused.node, opset=fused.opset, by="test", names=fused.names)
    import_domains(model)
    return model


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_layer_in_every_dialect_says_what_torch_says(
    traced: onnx.ModelProto, layer: nn.Module, dialect: str
) -> None:
    model = in_dialect(ir.from_proto(traced), dialect)
    (node,) = (each for each in model.graph if find(each))
    assert graph.static_shape(node.outputs[0]) in ((1, 5, 8, 32), (1, 5, 256))
    random = np.random.default_rng(1)
    feed = {n: random.random(shape, np.float32) for n, shape in SHAPES.items()}
    want = layer(*(torch.from_numpy(array) for array in feed.values()))
    got = run(expanded(model), feed)
    np.testing.assert_allclose(got, want.numpy(), rtol=0, atol=1e-4)


def test_a_library_without_the_operator_is_an_error() -> None:
    with pytest.raises(RecipeError, match="--dialect sparsedrive: no library of"):
        ExportOptions(dialect="sparsedrive")


@pytest.fixture(scope="module", params=[13, 17])
def vad(
    request: pytest.FixtureRequest,
    vad_size: VadSize,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    path = tmp_path_factory.mktemp("fused") / f"own-{request.param}.onnx"
    return vad_size.export(path, opset=request.param, fused=True)


@pytest.mark.slow
@pytest.mark.parametrize("dialect", ["tensorrt", "mmdeploy", "derryhub"])
def test_vad_tiny_in_a_dialect_says_what_torch_says(
    vad: Path,
    dialect: str,
    vad_torch: VadTiny,
    vad_scenes: list[Frame],
    no_bev: NDArray[np.float32],
) -> None:
    model = in_dialect(graph.load(vad), dialect)
    assert len(fused_nodes(model)) == 12
    feed: dict[str, Any] = {**vad_scenes[0], "prev_bev": no_bev}
    with torch.no_grad():
        want = vad_torch(*(torch.from_numpy(each) for each in feed.values()))
    got = run(expanded(model), feed)
    assert np.abs(got - want[0].numpy()).max() < 1e-4 * want[0].abs().max()
