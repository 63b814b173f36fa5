from pathlib import Path

import numpy as np
import onnx_ir as ir
import onnxruntime as ort
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import PassError
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.passes import fold_with_onnxsim
from me2e_compress.passes.fold_with_onnxsim import FoldWithOnnxsim
from tests.passes.small import NO_MODULES


@pytest.fixture(scope="module")
def model() -> ir.Model:
    made = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17, "custom_op": 1]>'
        "g (float[6] x) => (float[2, 3] y)"
        " <float[2, 3] w = {1.0, 2.0, 3.0, 4.0, 5.0, 6.0}> {"
        " s = Shape (w)  r = Reshape (x, s)  t = Mul (w, w)  y = Add (r, t) }"
    )
    for node, module in zip(made.graph, ("det", "det", "neck", "planner"), strict=True):
        node.name = f"/{module}/{node.op_type}"
        provenance.stamp(node, Provenance(module, (node.name,)))
    made.metadata_props["me2e.stack"] = "vad-tiny"
    return made


@pytest.fixture(scope="module")
def folded(model: ir.Model) -> ir.Model:
    return FoldWithOnnxsim().run(model, NO_MODULES).model


def test_what_depends_on_no_input_is_folded(model: ir.Model, folded: ir.Model) -> None:
    assert [node.op_type for node in folded.graph] == ["Reshape", "Add"]
    x = np.random.default_rng(3).standard_normal(6).astype(np.float32)
    before, after = (
        ort.InferenceSession(ir.to_proto(m).SerializeToString()).run(None, {"x": x})[0]
        for m in (model, folded)
    )
    np.testing.assert_array_equal(before, after)


def test_names_pasts_and_metadata_come_back(folded: ir.Model) -> None:
    assert [node.name for node in folded.graph] == ["/det/Reshape", "/planner/Add"]
    assert [provenance.read(node) for node in folded.graph] == [
        Provenance("det", ("/det/Reshape",)),
        Provenance("planner", ("/planner/Add",)),
    ]
    assert folded.metadata_props == {"me2e.stack": "vad-tiny"}
    assert folded.producer_name != "onnx-simplifier"
    tensors = [value.const_value for value in folded.graph.initializers.values()]
    assert tensors
    assert not any(isinstance(tensor, ir.ExternalTensor) for tensor in tensors)
    again = FoldWithOnnxsim().run(folded, NO_MODULES)
    assert again.changes == 0
    assert graph.digest(again.model) == graph.digest(folded)


def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    script = tmp_path / "stand_in.py"
    script.write_text(code)
    monkeypatch.setattr(fold_with_onnxsim, "_WORKER", script)


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import os; os.abort()", "was killed by signal 6"),
        ("raise SystemExit('no such thing')", "ended with code 1 and said: no such"),
        ("raise ValueError('a\\nb')", "ended with code 1 and said: b"),
    ],
)
def test_a_crash_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: ir.Model,
    code: str, reason: str,
) -> None:  # fmt: skip
    stand_in(tmp_path, monkeypatch, code)
    with pytest.raises(PassError) as caught:
        FoldWithOnnxsim().run(model, NO_MODULES)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_process_that_takes_too_long_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: ir.Model
) -> None:
    stand_in(tmp_path, monkeypatch, "import time; time.sleep(60)")
    with pytest.raises(PassError, match=r"longer than 0\.2 s"):
        FoldWithOnnxsim(timeout_s=0.2).run(model, NO_MODULES)
