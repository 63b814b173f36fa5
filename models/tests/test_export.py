import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from numpy.typing import NDArray

from me2e_compress.base.errors import GraphError
from me2e_compress.driving.adapter import ImageNormalization
from me2e_compress.runtime.plan_adapter import PlanAdapter
from models import export as exporting
from models.export import export
from models.stacks import HIGHWAY, STACKS, VAD_TINY, Stack
from models.synthetic_frames import Frame
from models.vad.stack import VadTiny

TINY = replace(VAD_TINY, name="tiny", inputs={"x": (1,)}, outputs=("y",))

pytestmark = pytest.mark.xdist_group("vad")


@pytest.fixture(scope="module")
def graph(vad_tiny: Path) -> onnx.ModelProto:
    return onnx.load(vad_tiny)


@pytest.fixture(scope="module")
def drives(
    vad_tiny: Path,
    vad_torch: VadTiny,
    vad_scenes: list[Frame],
    no_bev: NDArray[np.float32],
) -> list[dict[str, float]]:
    """Relative error of every output, for a first frame and for the one after it."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(
        str(vad_tiny), options, providers=["CPUExecutionProvider"]
    )
    errors, bev = [], no_bev
    for frame in vad_scenes[:2]:
        feed = {**frame, "prev_bev": bev}
        got = session.run(None, feed)
        with torch.no_grad():
            expected = vad_torch(*(torch.from_numpy(value) for value in feed.values()))
        errors.append(
            {
                name: float(np.abs(a - b.numpy()).max() / b.abs().max())
                for name, a, b in zip(VAD_TINY.outputs, got, expected, strict=True)
            }
        )
        bev = got[0]
    return errors


@pytest.mark.parametrize("frame", [0, 1])
def test_onnxruntime_agrees_with_torch(
    drives: list[dict[str, float]], frame: int
) -> None:
    wrong = {name: error for name, error in drives[frame].items() if error > 1e-4}
    assert wrong == {}


def test_parameters_keep_their_names(
    graph: onnx.ModelProto, vad_torch: VadTiny
) -> None:
    initializers = {tensor.name for tensor in graph.graph.initializer}
    expected = {
        name
        for name in vad_torch.state_dict()
        if not name.endswith(("code_weights", "num_batches_tracked"))
    }
    assert initializers == expected


def test_nodes_carry_the_published_scopes(graph: onnx.ModelProto) -> None:
    names = [node.name for node in graph.graph.node]
    for scope in (
        "/img_backbone/layer1/layer1.0/conv1/Conv",
        "/img_neck/lateral_convs.0/conv/Conv",
        "/pts_bbox_head/transformer/encoder/layers.0/attentions.1/"
        "deformable_attention/GridSample",
        "/pts_bbox_head/transformer/map_decoder/layers.2/attentions.1/GridSample",
        "/pts_bbox_head/ego_map_decoder/layers.0/attentions.0/attn/MatMul",
    ):
        assert scope in names


def test_types_shapes_and_samplers(graph: onnx.ModelProto) -> None:
    inferred = onnx.shape_inference.infer_shapes(graph, data_prop=False)
    types = {value.type.tensor_type.elem_type for value in inferred.graph.value_info}
    assert onnx.TensorProto.DOUBLE not in types
    kinds = [node.op_type for node in graph.graph.node]
    assert kinds.count("GridSample") == 13
    assert not {"Loop", "If", "NonZero", "TopK"} & set(kinds)
    for value in (*graph.graph.input, *graph.graph.output):
        assert all(d.dim_value > 0 for d in value.type.tensor_type.shape.dim)


def test_metadata_says_what_the_file_is(graph: onnx.ModelProto) -> None:
    said = {entry.key: entry.value for entry in graph.metadata_props}
    assert said["me2e.stack"] == "vad-tiny"
    assert json.loads(said["me2e.recurrent"]) == {"prev_bev": "bev_embed"}
    assert json.loads(said["me2e.plan"]) == {
        "output": "ego_fut_preds",
        "deltas": True,
        "command_input": None,
        "default_mode": 2,
    }
    assert json.loads(said["me2e.image"])["order"] == "rgb"


@pytest.mark.parametrize(
    ("stack", "opset", "words"),
    [
        ("vad-tiny", 12, "opset 12: 13 to 18 work"),
        ("vad-tiny", 19, "opset 19: 13 to 18 work"),
        ("vad-huge", 17, "no stack 'vad-huge': there are vad-tiny"),
        ("highway", 17, "no stack 'highway'"),
        ("lead-tiny", 13, "opset 13: 14 to 18 work"),
    ],
)
def test_what_no_exporter_writes_is_refused(
    tmp_path: Path, stack: str, opset: int, words: str
) -> None:
    with pytest.raises(GraphError, match=words):
        export(stack, tmp_path / "x.onnx", opset=opset)


def test_another_opset_in_the_file_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = onnx.load

    def other(file: Path) -> onnx.ModelProto:
        model = load(file)
        model.opset_import[0].version = 18
        return model

    monkeypatch.setattr(exporting, "build", lambda stack, **_: torch.nn.ReLU())
    monkeypatch.setattr(onnx, "load", other)
    monkeypatch.setattr(exporting, "find", lambda name: TINY)
    with pytest.raises(GraphError, match="asked for opset 17, torch wrote"):
        export("tiny", tmp_path / "x.onnx")
    assert list(tmp_path.iterdir()) == []


def test_examples_have_the_types_of_the_inputs() -> None:
    by_name = dict(zip(HIGHWAY.inputs, exporting.example(HIGHWAY), strict=True))
    assert by_name["command"].dtype == torch.int64
    assert by_name["timestamp"].dtype == torch.float32
    assert tuple(by_name["prev_memory"].shape) == HIGHWAY.inputs["prev_memory"]


@pytest.mark.parametrize("stack", STACKS.values(), ids=lambda stack: stack.name)
def test_a_driver_reads_the_metadata_of_every_stack(stack: Stack) -> None:
    said = stack.metadata()
    norm = ImageNormalization.of(said)
    assert (norm.mean, norm.std) == (stack.image.mean, stack.image.std)
    plan = PlanAdapter.of(said, stack.outputs)
    assert plan is not None
    assert plan.output == stack.plan
