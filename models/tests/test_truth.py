from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import onnx
import pytest
import torch
from torch import nn

from me2e_compress.base.errors import GraphError
from models.regions import listening, region
from models.stacks import VAD_TINY
from models.tests import truth
from models.tests.truth import NOT_COMPUTE, MacCounter, Truth

pytestmark = pytest.mark.xdist_group("vad")

MODULES = ["backbone", "bev_encoder", "det", "map", "motion", "neck", "planner"]


def test_every_compute_node_has_a_module(vad_truth: Truth, vad_tiny: Path) -> None:
    nodes = onnx.load(vad_tiny, load_external_data=False).graph.node
    compute = [node.name for node in nodes if node.op_type not in NOT_COMPUTE]
    assert sorted(vad_truth.modules) == sorted(compute)
    assert sorted(set(vad_truth.modules.values())) == MODULES


SCOPES = {
    "/img_backbone/": "backbone",
    "/img_neck/": "neck",
    "/pts_bbox_head/transformer/encoder/": "bev_encoder",
    "/pts_bbox_head/transformer/decoder/": "det",
    "/pts_bbox_head/transformer/map_decoder/": "map",
    "/pts_bbox_head/lane_encoder/": "map",
    "/pts_bbox_head/motion_map_decoder/": "motion",
    "/pts_bbox_head/agent_fus_mlp/": "planner",
}


def test_scopes_and_truth_agree(vad_truth: Truth) -> None:
    for start, module in SCOPES.items():
        found = {m for n, m in vad_truth.modules.items() if n.startswith(start)}
        assert found == {module}, start


def test_glue_of_the_head_is_told_apart(vad_truth: Truth) -> None:
    """Names say only /pts_bbox_head; the truth says more."""
    glue = Counter(
        module
        for name, module in vad_truth.modules.items()
        if name.startswith("/pts_bbox_head/") and name.count("/") == 2
    )
    assert sorted(glue) == ["bev_encoder", "det", "map", "motion", "planner"]


def test_every_module_multiplies(vad_truth: Truth) -> None:
    assert sorted(vad_truth.macs) == MODULES
    assert min(vad_truth.macs.values()) > 0


def test_counter_counts_products_only() -> None:
    counts: list[int] = []
    layer = nn.Linear(3, 5)
    with torch.no_grad(), MacCounter(counts.append):
        torch.relu(layer(torch.ones(7, 3)))
        torch.matmul(torch.ones(2, 4, 6), torch.ones(2, 6, 8))
    assert counts == [7 * 3 * 5, 2 * 4 * 6 * 8]


def test_products_outside_of_every_region_are_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(truth, "example", lambda spec: (torch.ones(1, 3),))
    with pytest.raises(GraphError, match="multiplies outside of every region"):
        truth.count_macs(VAD_TINY, nn.Linear(3, 5))


def test_listeners_nest_and_leave() -> None:
    heard: list[str] = []

    @contextmanager
    def listener(module: str) -> Iterator[None]:
        heard.append(module)
        yield
        heard.append(f"end of {module}")

    with listening(listener), region("det"), region("map"):
        pass
    with region("motion"):
        pass
    assert heard == ["det", "map", "end of map", "end of det"]
