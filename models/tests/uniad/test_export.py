"""UniAD in small, as ONNX: onnxruntime against torch, scopes, shapes."""

import json
from collections import Counter

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime
import pytest
import torch

from me2e_compress.graph.modules.assign import assign
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.operators import expand, fused_nodes, import_domains
from me2e_compress.targets import TARGETS
from models.bev.sizes import Sampling
from models.dialect import in_dialect
from models.export import trace
from models.stacks import UNIAD_TINY, UNIAD_TRT, Stack
from models.tests.truth import truth_of
from models.tests.uniad.small import (
    Arrays,
    nothing_before,
    small_frames,
    small_spec,
    small_uniad,
)

pytestmark = pytest.mark.xdist_group("uniad")

FRAMES = 10
MODULES = [
    "backbone", "bev_encoder", "map", "motion", "neck", "occ", "planner", "track",
]  # fmt: skip


@pytest.fixture(scope="module")
def traced() -> onnx.ModelProto:
    return trace(small_spec(), small_uniad(), 17)


def errors_of(graph: onnx.ModelProto, frames: int) -> list[dict[str, float]]:
    """Relative error of every output, frame by frame, each fed its own state."""
    spec, model = small_spec(), small_uniad()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph.SerializeToString(), options)
    ours, theirs = nothing_before(), nothing_before()
    errors = []
    for frame in small_frames(frames):
        with torch.no_grad():
            fed = {**frame, **ours}
            wanted = model(*(torch.from_numpy(fed[name]) for name in spec.inputs))
        want = dict(zip(spec.outputs, (each.numpy() for each in wanted), strict=True))
        ran = session.run(list(spec.outputs), {**frame, **theirs})
        got: Arrays = {n: np.asarray(a) for n, a in zip(spec.outputs, ran, strict=True)}
        errors.append({name: off(got[name], want[name]) for name in spec.outputs})
        ours = {name: want[answer] for name, answer in spec.recurrent.items()}
        theirs = {name: got[answer] for name, answer in spec.recurrent.items()}
    return errors


def off(got: np.ndarray, want: np.ndarray) -> float:
    largest = float(np.abs(want).max())
    return float(np.abs(got - want).max()) / (largest or 1.0)


def test_onnxruntime_agrees_with_torch_while_tracks_come_and_go(
    traced: onnx.ModelProto,
) -> None:
    for errors in errors_of(traced, FRAMES):
        assert {name: e for name, e in errors.items() if e > 1e-4} == {}


@pytest.mark.slow
@pytest.mark.parametrize(("opset", "sampling"), [(13, "gather"), (18, "operator")])
def test_other_opsets_agree_too(opset: int, sampling: Sampling) -> None:
    graph = trace(small_spec(), small_uniad(sampling), opset)
    for errors in errors_of(graph, 3):
        assert {name: e for name, e in errors.items() if e > 1e-4} == {}


@pytest.mark.slow
def test_the_map_knows_the_module_of_nearly_every_node(
    traced: onnx.ModelProto,
) -> None:
    known = truth_of(small_spec(), small_uniad(), plain=traced)
    assert sorted(known.macs) == MODULES
    graph = ir.from_proto(traced)
    placed = assign(graph, ModuleMap.load("uniad"))
    nodes = [node for node in graph.graph if node.name in known.modules]
    wrong = Counter(
        (known.modules[node.name or ""], placed.module_of(node))
        for node in nodes
        if known.modules[node.name or ""] != placed.module_of(node)
    )
    assert wrong.total() <= 0.01 * len(nodes), wrong


def test_scopes_are_the_published_ones(traced: onnx.ModelProto) -> None:
    names = {node.name.rpartition("/")[0] for node in traced.graph.node}
    assert names >= {
        "/img_neck/fpn_convs.3/conv",
        "/pts_bbox_head/transformer/encoder/layers.0/attentions.1/deformable_attention",
        "/pts_bbox_head/transformer/decoder/layers.1/attentions.0/attn",
        "/query_interact/self_attn",
        "/memory_bank/temporal_attn",
        "/seg_head/transformer/encoder/layers.1/ffns.0",
        "/seg_head/things_mask_head/blocks.3/attn",
        "/motion_head/motionformer/bev_interaction_layers.2/attentions.0",
        "/occ_head/transformer_decoder/layers.4/attentions.1/attn",
        "/planning_head/attn_module/layers.2/multihead_attn",
    }


def test_nothing_is_float64_and_no_shape_depends_on_data(
    traced: onnx.ModelProto,
) -> None:
    inferred = onnx.shape_inference.infer_shapes(traced)
    types = {value.type.tensor_type.elem_type for value in inferred.graph.value_info}
    assert onnx.TensorProto.DOUBLE not in types
    kinds = Counter(node.op_type for node in traced.graph.node)
    assert not {"Loop", "If", "NonZero", "Inverse"} & set(kinds)
    assert kinds["TopK"] == 1
    for value in (*traced.graph.input, *traced.graph.output):
        assert all(d.dim_value > 0 for d in value.type.tensor_type.shape.dim)


def test_tensorrt_takes_every_node(traced: onnx.ModelProto) -> None:
    assert TARGETS.parse("tensorrt").lint(ir.from_proto(traced)) == ()


@pytest.fixture(scope="module")
def fused() -> onnx.ModelProto:
    return trace(small_spec(), small_uniad("fused"), 17)


@pytest.mark.slow
def test_every_deformable_attention_is_one_node(fused: onnx.ModelProto) -> None:
    """Twice in an encoder layer, once in every other."""
    assert len(fused_nodes(ir.from_proto(fused))) == 2 + 2 + 2 + 2 + 3


@pytest.mark.slow
@pytest.mark.parametrize("dialect", ["tensorrt", "dl4agx-uniad"])
def test_a_plugin_says_what_standard_operators_say(
    fused: onnx.ModelProto, dialect: str
) -> None:
    model = in_dialect(ir.from_proto(fused), dialect)
    for each in fused_nodes(model):
        expand(each.node, opset=each.opset, by="test", names=each.names)
    import_domains(model)
    for errors in errors_of(ir.to_proto(model), 3):
        assert {name: e for name, e in errors.items() if e > 1e-4} == {}


@pytest.mark.parametrize("stack", [UNIAD_TINY, UNIAD_TRT], ids=lambda each: each.name)
def test_every_previous_value_is_fed_back(stack: Stack) -> None:
    said = json.loads(stack.metadata()["me2e.recurrent"])
    assert set(said) == {name for name in stack.inputs if name.startswith("prev_")}
    named = {name: f"next_{name.removeprefix('prev_')}" for name in said}
    assert said == named | {"prev_bev": "bev_embed"}
    assert set(said.values()) <= set(stack.outputs)
