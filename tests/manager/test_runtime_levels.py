"""Which node onnxruntime's optimizations go wrong at, on a session that errs at one."""

import onnx_ir as ir
import pytest

from me2e_compress.manager import runtime_levels, verification_inputs
from me2e_compress.manager.runtime_levels import LEVELS
from me2e_compress.manager.verification_inputs import VerificationInputs
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Level, Session

CHAIN = """
<ir_version: 9, opset_import: ["" : 17]>
chain (float[1,8] x) => (float[1,8] y, float[1,8] z) {
    ["n0"] a = Sigmoid(x)
    ["aside"] z = Exp(x)
    ["n1"] b = Tanh(a)
    ["n2"] c = Cos(b)
    ["n3"] d = Sin(c)
    ["n4"] e = Tanh(d)
    ["n5"] y = Cos(e)
}
"""


@pytest.mark.parametrize("guilty", [f"n{index}" for index in range(6)])
@pytest.mark.parametrize("level", ["basic", "layout"])
def test_the_first_node_that_a_level_gets_wrong_is_named(
    guilty: str, level: Level, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Errs(Session):
        """Takes one node for a Neg, from a level on."""

        def __init__(
            self, model: ir.Model, *, optimize: Level = "all", provider: Provider = CPU
        ) -> None:
            model = model.clone()
            for node in model.graph:
                if node.name == guilty and optimize in LEVELS[LEVELS.index(level) :]:
                    node.op_type = "Neg"
            super().__init__(model, optimize="none", provider=provider)

    monkeypatch.setattr(runtime_levels, "Session", Errs)
    monkeypatch.setattr(verification_inputs, "Session", Errs)
    model = ir.from_onnx_text(CHAIN)
    inputs = VerificationInputs.of(model, None, 0, 2)
    allowed = {"y": 1e-4, "z": 1e-4}

    (said,) = runtime_levels.disagreements(
        {"before": model}, ("y", "z"), allowed, inputs
    )

    assert f"another y of the graph before at its level {level} than" in said
    assert f"from node {guilty} (" in said
