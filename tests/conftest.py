from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import onnx
import onnx_ir as ir
import pytest

from me2e_compress.modules import ModuleMap
from me2e_compress.passes.base import Context
from me2e_compress.runtime import first_opening
from me2e_compress.zoo import truth
from me2e_compress.zoo.export import build, export
from me2e_compress.zoo.stacks import find

if TYPE_CHECKING:
    from me2e_compress.zoo.vad.stack import VadTiny

DRIVER = """
<ir_version: 9, opset_import: ["" : 17]>
driver (float[1,4] camera) => (float[1,4] plan) {
    ["/backbone/Relu"] features = Relu(camera)
    ["/occ_head/Sigmoid"] occupancy = Sigmoid(features)
    ["/plan_head/Add"] plan = Add(features, occupancy)
}
"""

DRIVER_MAP = """
[modules.backbone]
role = "feature"
optional = ["backbone"]
[modules.occ]
role = "prediction"
optional = ["occ_head"]
[modules.planner]
role = "prediction"
optional = ["plan_head"]
"""


@pytest.fixture(autouse=True)
def opened_before(request: pytest.FixtureRequest) -> Iterator[None]:
    """No graph is opened apart first, but in the tests of just that."""
    if request.node.get_closest_marker("opens_apart"):
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(first_opening, "try_apart", lambda *_, **__: 0.0)
        yield


@pytest.fixture
def driver() -> ir.Model:
    """A driving model in three nodes."""
    return ir.from_onnx_text(DRIVER)


@pytest.fixture
def driver_map() -> ModuleMap:
    return ModuleMap.parse(DRIVER_MAP, "driver")


@pytest.fixture
def context(driver_map: ModuleMap) -> Context:
    return Context(driver_map)


@pytest.fixture(scope="session")
def vad_tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported reference stack, seed 0, opset 17, nuScenes heads."""
    return export("vad-tiny", tmp_path_factory.mktemp("zoo") / "vad-tiny.onnx")


@pytest.fixture(scope="session")
def vad_torch() -> "VadTiny":
    """The same in torch."""
    from me2e_compress.zoo.vad.stack import VadTiny

    model = build("vad-tiny")
    assert isinstance(model, VadTiny)
    return model


@pytest.fixture(scope="session")
def vad_truth(vad_tiny: Path, vad_torch: "VadTiny") -> truth.Truth:
    """What its trace knew: the module of every node, and torch's own MACs."""
    plain = onnx.load(vad_tiny, load_external_data=False)
    return truth.truth_of(find("vad-tiny"), vad_torch, plain=plain)
