"""What belongs to which module of the driver, once it is exported."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.assign import detect
from me2e_compress.manager import PassManager
from me2e_compress.passes import Context
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.import_normalize import ImportNormalize

MADE_BY = {
    "plan": "planner",
    "boxes": "track",
    "scores": "track",
    "futures": "motion",
    "route": "map",
    "occupancy": "occ",
    "prev_bev_out": "bev_encoder",
    "prev_memory_out": "planner",
}


@pytest.fixture(scope="module")
def folded(exported: Path) -> ir.Model:
    model = graph.load(exported)
    steps = (ImportNormalize(), FoldConstants(through_compute=False))
    manager = PassManager(steps, verify_frames=0)
    return manager.run(model, Context(detect(model))).model


def test_every_output_is_of_its_own_module(folded: ir.Model) -> None:
    found = {
        str(value.name): provenance.module_of(producer)
        for value in folded.graph.outputs
        if (producer := value.producer()) is not None
    }
    assert found == MADE_BY


@pytest.mark.parametrize("module", ["track", "map", "motion", "occ"])
def test_a_module_goes_with_its_outputs_and_nothing_else(
    folded: ir.Model, module: str
) -> None:
    cut = AblateModules(drop=(module,), fill="zeros", drop_outputs=True)
    made = cut.run(folded.clone(), Context(detect(folded))).model
    left = [name for name, maker in MADE_BY.items() if maker != module]
    assert [value.name for value in made.graph.outputs] == left
    # the planner still knows what it was told, whoever is gone
    (command,) = (value for value in made.graph.inputs if value.name == "command")
    readers = {provenance.module_of(node) for node in command.consumers()}
    assert "planner" in readers
