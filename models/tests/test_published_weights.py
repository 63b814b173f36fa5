"""Weights of a checkpoint: what fits is taken whole, what does not is named."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from me2e_compress.base.errors import GraphError
from models.export import trace
from models.published_names import PUBLISHED, NameMatch
from models.published_weights import (
    PublishedWeights,
    mismatch,
    published_weights,
    taken,
)
from models.state_dict import read_state_dict
from models.tcp.stack import Tcp
from models.tests.published_files import Tensors, averaged, lightning, mmcv, saved, thin
from models.tests.published_layouts import published
from models.tests.tcp.small import SMALL, small_spec


@pytest.fixture
def tensors() -> Tensors:
    return thin(published("tcp"))


@pytest.fixture
def trained() -> Tcp:
    """A small original: its statistics are no fresh model's."""
    torch.manual_seed(5)
    model = Tcp(config=SMALL).requires_grad_(False).eval()
    for name, each in model.state_dict().items():
        if each.is_floating_point():
            drawn = 0.2 * torch.randn(each.shape)
            each.copy_(drawn.abs() + 0.5 if name.endswith("running_var") else drawn)
    return model


def read(path: Path, *, ema: bool = False) -> PublishedWeights:
    """Read a small original."""
    own = Tcp(config=SMALL)
    return taken(NameMatch(own, PUBLISHED["tcp"], read_state_dict(path), ema))


def test_the_graph_answers_as_the_original(tmp_path: Path, trained: Tcp) -> None:
    weights = read(saved(tmp_path / "a.ckpt", lightning(trained.state_dict())))
    model = Tcp(config=SMALL).requires_grad_(False).eval()
    weights.fill(model)
    spec = small_spec("bench2drive")
    graph = trace(spec, model, 17)

    rng = np.random.default_rng(1)
    feed = {
        name: rng.standard_normal(shape, dtype=np.float32)
        for name, shape in spec.inputs.items()
    }
    session = onnxruntime.InferenceSession(graph.SerializeToString())
    wanted = trained(*(torch.from_numpy(each) for each in feed.values()))
    for got, want in zip(session.run(None, feed), wanted, strict=True):
        np.testing.assert_allclose(np.asarray(got), want, rtol=1e-4, atol=1e-4)
    held = {
        each.name: onnx.numpy_helper.to_array(each) for each in graph.graph.initializer
    }
    name = "perception.layer1.0.bn1.running_var"
    np.testing.assert_array_equal(held[name], trained.state_dict()[name])


def test_the_record_names_the_file_and_what_only_training_reads(
    tmp_path: Path, tensors: Tensors
) -> None:
    path = saved(tmp_path / "tcp.pth", mmcv(tensors))
    record = published_weights("tcp", path).record

    said = json.loads(record.metadata()["me2e.weights"])
    assert said == {
        "file": "tcp.pth",
        "sha256": record.sha256,
        "epoch": 60,
        "iteration": 211_080,
        "averaged": False,
    }
    assert record.lines() == (
        f"weights: tcp.pth, epoch 60, iteration 211080, sha256 {record.sha256}",
        "left out, 22 tensors that driving does not read: speed_branch,"
        " value_branch_traj, value_branch_ctrl, feature_branch_traj,"
        " feature_branch_ctrl",
    )


@pytest.mark.parametrize("type_", [torch.bfloat16, torch.float64])
def test_other_precisions_become_float32_and_are_said(
    tmp_path: Path, tensors: Tensors, type_: torch.dtype
) -> None:
    cast = {n: each.to(type_) if each.dim() else each for n, each in tensors.items()}
    found = published_weights("tcp", saved(tmp_path / "a.pth", cast))

    floats = {each.dtype for n, each in found.tensors.items() if "tracked" not in n}
    assert floats == {torch.float32}
    kind = str(type_).removeprefix("torch.")
    assert f"230 tensors of {kind} converted to float32" in found.record.lines()
    assert found.record.converted == {kind: 230}


def test_counters_may_be_missing(tmp_path: Path, tensors: Tensors) -> None:
    old = {name: each for name, each in tensors.items() if "tracked" not in name}
    found = published_weights("tcp", saved(tmp_path / "a.pth", old)).tensors

    assert found["perception.bn1.num_batches_tracked"] == 0


@pytest.mark.parametrize("ema", [False, True])
def test_moving_averages_are_taken_where_asked_else_said(
    tmp_path: Path, trained: Tcp, ema: bool
) -> None:
    state = trained.state_dict()
    names = [name for name, _ in trained.named_parameters()]
    found = read(saved(tmp_path / "a.pth", mmcv(averaged(state, names))), ema=ema)

    bias, statistics = "output_traj.bias", "perception.bn1.running_mean"
    assert torch.equal(found.tensors[bias], state[bias] + int(ema))
    assert torch.equal(found.tensors[statistics], state[statistics])
    assert found.record.averaged is ema
    said = f"left out: {len(names)} moving averages; --ema takes them"
    assert (said in found.record.lines()) is not ema


def test_averages_that_are_not_there_are_missing(
    tmp_path: Path, tensors: Tensors
) -> None:
    path = saved(tmp_path / "a.pth", tensors)
    with pytest.raises(GraphError, match=r"missing \(ema_perception_conv1_weight, "):
        published_weights("tcp", path, ema=True)


BIAS = "merge.2.bias"


@pytest.mark.parametrize(
    ("altered", "words"),
    [
        ({BIAS: None}, "names missing (merge.2.bias)"),
        ({BIAS: torch.zeros(255)}, "merge.2.bias is [255] in it, [256] here"),
        (
            {BIAS: torch.zeros(256, dtype=torch.int64)},
            "1 not floating-point (merge.2.bias is int64)",
        ),
        ({BIAS: torch.full((256,), float("nan"))}, "1 not finite (merge.2.bias)"),
        # finite in float64 alone
        (
            {BIAS: torch.full((256,), 1e300, dtype=torch.float64)},
            "1 not finite (merge.2.bias)",
        ),
        ({"brake_head.bias": torch.zeros(1)}, "1 unexpected (brake_head.bias)"),
    ],
    ids=["missing", "shape", "type", "nan", "overflow", "unexpected"],
)
def test_what_does_not_fit_is_named_in_one_line(
    tmp_path: Path,
    tensors: Tensors,
    altered: dict[str, torch.Tensor | None],
    words: str,
) -> None:
    held = {**tensors, **altered}
    path = tmp_path / "a.pth"
    saved(path, {name: each for name, each in held.items() if each is not None})
    with pytest.raises(GraphError) as error:
        published_weights("tcp", path)
    line = str(error.value)
    assert line.startswith(f"{path}: not the weights of tcp: ")
    assert words in line
    assert len(line) < 600 + len(str(path))
    assert "\n" not in line


def test_the_heads_that_would_fit_are_said(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.pth", thin(published("vad-tiny", "bench2drive")))
    with pytest.raises(GraphError, match=r"; it fits --heads bench2drive$"):
        published_weights("vad-tiny", path)


def test_every_name_that_does_not_fit_can_be_asked_for(tmp_path: Path) -> None:
    found = mismatch("tcp", saved(tmp_path / "a.pth", thin(published("vad-tiny"))))
    assert len(found.missing) > 100
    assert set(found.unexpected) == set(published("vad-tiny"))
    assert "(perception.conv1.weight, perception.bn1.weight, " in found.line()


def test_anchors_of_uniad_are_asked_for(tmp_path: Path) -> None:
    held = published("uniad-tiny")
    del held["motion_head.kmeans_anchors"]
    path = saved(tmp_path / "a.pth", thin(held))
    assert mismatch("uniad-tiny", path).missing == ["motion_head.kmeans_anchors"]


def test_a_stack_without_an_original(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="uniad-trt has no original"):
        published_weights("uniad-trt", tmp_path / "a.pth")
