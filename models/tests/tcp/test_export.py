from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray

from me2e_compress.base.errors import GraphError
from me2e_compress.graph.modules.assign import assign, detect
from me2e_compress.graph.modules.module_map import ModuleMap
from models.export import ExportOptions, export_stack, trace
from models.stacks import Stack
from models.tcp.config import ActionHeads
from models.tcp.stack import Tcp
from models.tests.tcp.small import small_spec, small_tcp
from models.tests.truth import truth_of

Arrays = dict[str, NDArray[np.float32]]


@pytest.fixture
def feed() -> Arrays:
    rng = np.random.default_rng(1)
    return {
        name: rng.standard_normal(shape, dtype=np.float32)
        for name, shape in small_spec("bench2drive").inputs.items()
    }


@pytest.mark.parametrize(("heads", "opset"), [("bench2drive", 13), ("beta", 17)])
def test_onnxruntime_agrees_with_torch(
    heads: ActionHeads, opset: int, feed: Arrays
) -> None:
    spec, model = small_spec(heads), small_tcp(heads)
    check_answers(trace(spec, model, opset), spec, model, feed)


def test_a_dynamo_export_agrees_and_keeps_scopes_and_parameters(feed: Arrays) -> None:
    spec, model = small_spec("bench2drive"), small_tcp("bench2drive")
    written = trace(spec, model, 18)
    check_answers(written, spec, model, feed)
    graph = ir.from_proto(written)
    assert set(graph.graph.initializers) >= set(dict(model.named_parameters()))
    assert detect(graph).name == "tcp"


def check_answers(
    graph: onnx.ModelProto, spec: Stack, model: Tcp, feed: Arrays
) -> None:
    session = onnxruntime.InferenceSession(graph.SerializeToString())
    got = session.run(list(spec.outputs), feed)
    want = model(*(torch.from_numpy(value) for value in feed.values()))
    for one, other in zip(got, want, strict=True):
        np.testing.assert_allclose(np.asarray(one), other.numpy(), rtol=1e-4, atol=1e-4)


def test_the_map_knows_the_module_of_every_node() -> None:
    spec, model = small_spec("bench2drive"), small_tcp("bench2drive")
    known = truth_of(spec, model).modules
    graph = ir.from_proto(trace(spec, model, 17))
    assert detect(graph).name == "tcp"
    placed = assign(graph, ModuleMap.load("tcp"))
    found = {n.name: placed.module_of(n) for n in graph.graph if n.name in known}
    assert found == known


def test_waypoints_do_not_depend_on_the_control_branch() -> None:
    """As the two heads are fused by the host, each must stand alone."""
    model = small_tcp("bench2drive")
    zeros = [torch.zeros(shape) for shape in small_spec("bench2drive").inputs.values()]
    before = model(*zeros)
    for name, parameter in model.named_parameters():
        if ModuleMap.load("tcp").match(name) == "control":
            parameter.zero_()
    after = model(*zeros)
    assert torch.equal(before[0], after[0])
    assert not torch.equal(before[1], after[1])


@pytest.mark.parametrize(
    ("stack", "options", "words"),
    [
        ("tcp", {"heads": "nuscenes"}, "tcp has no heads 'nuscenes': there is bench2"),
        ("uniad-tiny", {"heads": "nuscenes"}, "'nuscenes': there is nothing to choose"),
        ("tcp", {"dialect": "me2e"}, "tcp has no deformable attention"),
        (
            *("vad-tiny", {"dialect": "me2e", "opset": 18}),
            "opset 18 with plugins, which take up to 17",
        ),
    ],
)
def test_what_a_stack_does_not_have_is_refused(
    tmp_path: Path, stack: str, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(GraphError, match=words):
        export_stack(stack, tmp_path / "x.onnx", ExportOptions(**options))
