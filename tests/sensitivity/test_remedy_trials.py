"""What is behind a group, run alone, measures what the whole graph measures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.plan import plan_of
from me2e_compress.quantization.plan.overrides import Override, overrides_text
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity.remedy import Int8Node, RemedyTrials, int8_nodes
from me2e_compress.sensitivity.suffix import Suffix
from tests.frames import record
from tests.nets import MODULES, conv_attention, image, net

ROW = """
<ir_version: 9, opset_import: ["" : 17]>
row (float[1,64,64] image, float[1,64,64] memory, float[64,64] a, float[64,64] b,
     float[64,64] c, float[64,64] d)
    => (float[1,64,64] early, float[1,64,64] late, float[1,64,64] memory_out) {
    ["/backbone/a"] x = MatMul(image, a)
    ["/backbone/Relu"] early = Relu(x)
    ["/backbone/b"] y = MatMul(early, b)
    ["/head/Add"] seen = Add(y, memory)
    ["/head/c"] z = MatMul(seen, c)
    ["/head/Tanh"] memory_out = Tanh(z)
    ["/head/d"] late = MatMul(memory_out, d)
}
"""


def row() -> ir.Model:
    """Four layers in a row, and a state that the third reads."""
    random = np.random.default_rng(0)
    return net(ROW, {name: random.normal(0, 0.1, (64, 64)) for name in "abcd"})


class Searched:
    """A quantized graph, and trials of it on one frame."""

    def __init__(self, folder: Path, model: ir.Model, frame: dict[str, np.ndarray]):
        recording = CalibrationSet(record(folder / "frames", [frame]))
        context = Context(MODULES, recording)
        quantizer = QuantizeInt8(rules="paper")
        made = quantizer.run(model.clone(), context)
        plan = plan_of(made.model)
        assert plan is not None
        self.nodes = int8_nodes(plan)
        reference = Reference.of(Session(model), recording)

        def build(overrides: Sequence[Override]) -> ir.Model:
            path = folder / "o.toml"
            path.write_text(overrides_text(overrides))
            again = quantizer.with_options({"overrides": path})
            return again.run(model.clone(), context).model

        self.trials = RemedyTrials(model, build, reference)

    def both(self, group: tuple[Int8Node, ...]) -> tuple[Fidelity, Fidelity]:
        """Measure a group in int8, what is behind it alone, and the whole graph."""
        floats = [each for each in self.nodes if each not in group]
        return self.trials.measure(floats, group), self.trials.measure(floats)


@pytest.fixture
def captured(monkeypatch: pytest.MonkeyPatch) -> list[Suffix]:
    """What was captured."""
    found, whole = list[Suffix](), Suffix.capture

    def noted(self: Suffix, model: ir.Model, reference: Reference) -> Reference:
        found.append(self)
        return whole(self, model, reference)

    monkeypatch.setattr(Suffix, "capture", noted)
    return found


def test_a_group_at_the_end_is_measured_on_what_is_behind_it(
    tmp_path: Path, captured: list[Suffix], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("math.log2", lambda count: 4.0)  # a group of sixteen
    frame = np.random.default_rng(1).standard_normal((1, 64, 64)).astype("f")
    searched = Searched(tmp_path, row(), {"image": frame})

    part, whole = searched.both(searched.nodes[2:])

    assert [each.boundary for each in captured] == [("seen",)]
    assert captured[0].share == pytest.approx(0.5)
    assert [each.name for each in part.outputs] == ["late", "memory_out"]
    assert part.missing == ("early",)
    for each in part.outputs:
        (other,) = [o for o in whole.outputs if o.name == each.name]
        assert each.sqnr_db == pytest.approx(other.sqnr_db, abs=1e-3)


def test_a_group_that_everything_is_behind_runs_whole(
    tmp_path: Path, captured: list[Suffix]
) -> None:
    searched = Searched(tmp_path, conv_attention(), image(0))

    part, whole = searched.both(searched.nodes)

    assert not captured
    assert part == whole


def test_a_smaller_group_is_captured_again_and_another_one_too(
    tmp_path: Path, captured: list[Suffix], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("math.log2", lambda count: 8.0)
    frame = np.random.default_rng(1).standard_normal((1, 64, 64)).astype("f")
    searched = Searched(tmp_path, row(), {"image": frame})

    for group in (searched.nodes[2:], searched.nodes[3:], searched.nodes[1:]):
        part, whole = searched.both(group)
        for each in part.outputs:
            (other,) = [o for o in whole.outputs if o.name == each.name]
            assert each.sqnr_db == pytest.approx(other.sqnr_db, abs=1e-3)

    assert [each.boundary for each in captured] == [
        ("seen",),
        ("memory_out",),
        ("early",),
    ]
