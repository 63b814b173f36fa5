"""The map against what the exporter's own trace knew."""

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING

import onnx_ir as ir
import pytest
import torch

from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.assign import assign, detect, itemise
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.passes import Context
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.import_normalize import ImportNormalize
from models.vad.stack import VadTiny

if TYPE_CHECKING:
    from models.tests.modules.conftest import Reference

pytestmark = pytest.mark.xdist_group("vad")

PUBLISHED = {
    "backbone": 23_508_032,
    "neck": 1_114_624,
    "bev_encoder": 4_650_496,
    "det": 3_013_983,
    "map": 2_910_001 + 99_456,
    "motion": 2_216_077 - 99_456,
    "planner": 2_452_772,
}
"""Parameters of VAD-tiny, counted in torch; LaneNet (99,456) is the map's here, whose
points it encodes for the motion head and the planner alike."""

LOSS_WEIGHTS = 14
"""``code_weights`` and ``map_code_weights``: parameters of the training loss alone."""


def agreement(model: ir.Model, vad: "Reference") -> float:
    placed = assign(model, ModuleMap.load("vad"))
    known = vad.truth.modules
    names = [node.name or "" for node in vad.model.graph]
    hits = [
        placed.module_of(node) == known[name]
        for name, node in zip(names, model.graph, strict=True)
        if name in known
    ]
    assert len(hits) == len(known)
    return sum(hits) / len(hits)


def test_the_preset_is_found(vad: "Reference") -> None:
    nameless = vad.model.clone()
    nameless.metadata_props.clear()
    assert detect(vad.model).name == detect(nameless).name == "vad"


def test_compute_nodes_agree(vad: "Reference") -> None:
    assert agreement(vad.model, vad) >= 0.99


def test_they_agree_by_scope_and_neighbour_where_weights_lost_their_names(
    vad: "Reference",
) -> None:
    model = vad.model.clone()
    for index, value in enumerate(list(model.graph.initializers.values())):
        value.name = f"onnx::Weight_{index}"
    assert assign(model, ModuleMap.load("vad")).rules().get("parameter", 0) == 0
    assert agreement(model, vad) >= 0.99


def test_they_agree_by_parameter_and_neighbour_where_nodes_lost_their_names(
    vad: "Reference",
) -> None:
    model = vad.model.clone()
    for index, node in enumerate(model.graph):
        node.name = f"{node.op_type}_{index}"
        for value in node.outputs:
            value.name = f"v{index}_{value.index()}"
    assert assign(model, ModuleMap.load("vad")).rules().get("scope", 0) == 0
    assert agreement(model, vad) >= 0.99


def test_every_node_has_a_module_and_every_rule_was_needed(vad: "Reference") -> None:
    assert set(vad.placed.placements) == set(vad.model.graph.all_nodes())
    rules = vad.placed.rules()
    assert sorted(rules) == ["neighbour", "parameter", "scope"]
    assert min(rules.values()) > 500


def test_macs_of_every_module_are_torch_s(vad: "Reference") -> None:
    modules = ModuleMap.load("vad")
    context = Context(modules)
    model = ImportNormalize().run(vad.model.clone(), context).model
    graph.infer_shapes(model)
    model = FoldConstants(through_compute=False).run(model, context).model
    graph.infer_shapes(model)
    items = itemise(model, modules, provenance.module_of, graph.macs)
    assert {item.module: item.macs for item in items} == vad.truth.macs


def by_module(parameters: Mapping[str, int]) -> Counter[str]:
    """Count elements by what the map makes of a name; the loss has weights too."""
    modules = ModuleMap.load("vad")
    counts: Counter[str | None] = Counter()
    for name, elements in parameters.items():
        counts[modules.match(name)] += elements
    assert counts.pop(None) == LOSS_WEIGHTS
    return Counter({name: count for name, count in counts.items() if name})


def test_parameters_of_every_module_are_the_published_ones() -> None:
    with torch.device("meta"):
        parameters = dict(VadTiny().named_parameters())
    assert by_module({n: each.numel() for n, each in parameters.items()}) == PUBLISHED


def test_the_file_holds_all_parameters_but_those_of_the_loss(vad: "Reference") -> None:
    stored = {
        name: value.const_value.size
        for part in vad.model.graphs()
        for name, value in part.initializers.items()
        if value.const_value is not None
    }
    missing = vad.state_dict.items() - stored.items()
    counters = {name for name, _ in missing if name.endswith("num_batches_tracked")}
    assert len(counters) == 53
    assert {name for name, _ in missing} - counters == {
        *("pts_bbox_head.code_weights", "pts_bbox_head.map_code_weights")
    }
    assert stored.items() <= vad.state_dict.items()


def test_parameters_in_the_file_are_itemised(vad: "Reference") -> None:
    items = itemise(vad.model, ModuleMap.load("vad"), vad.placed.module_of)
    statistics = sum(
        count for name, count in vad.state_dict.items() if ".running_" in name
    )
    counted = {item.module: item.parameters for item in items}
    assert counted == by_module(vad.parameters) + Counter(backbone=statistics)
