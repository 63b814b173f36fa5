"""ONNX's own single-operator models, before and after the exact passes."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime
import pytest
from onnx.backend.test.case.test_case import TestCase as Case

from me2e_compress.graph import provenance
from me2e_compress.modules import ModuleMap
from me2e_compress.passes.base import Context, Pass
from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.fuse_basic import FuseBasic
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.runtime.native import REFUSALS

PASSES: tuple[Pass, ...] = (
    ImportNormalize(),
    FoldConstants(bytes_per_node=1 << 40),
    EliminateRedundant(),
    FuseBasic(),
)
NO_MODULES = Context(ModuleMap("none", ()))
NEWEST_IR = 13
"""The newest model format that onnxruntime reads; the suite's own may be newer."""

NEWEST_OPSET = 26

FAILURES: tuple[type[Exception], ...] = (
    *REFUSALS,
    RuntimeError,
    TypeError,
    ValueError,
)


@dataclasses.dataclass
class Outcome:
    """What came of all cases in one form: as they are, or with inputs baked in."""

    passed: int = 0
    folded: int = 0
    excepted: list[str] = dataclasses.field(default_factory=list)
    failed: list[str] = dataclasses.field(default_factory=list)


def load_cases() -> list[Case]:
    with warnings.catch_warnings():
        # Building the suite computes NaN and infinity on purpose.
        warnings.simplefilter("ignore")
        from onnx.backend.test.loader import load_model_tests

        cases = load_model_tests(kind="node")
    for case in cases:
        if case.model is not None:
            _lower(case.model)
    return cases


def _lower(model: onnx.ModelProto) -> None:
    """Say an older format and opset where they mean the same."""
    model.ir_version = min(model.ir_version, NEWEST_IR)
    nodes = [node for node in ir.from_proto(model).graph.all_nodes()]
    for opset in model.opset_import:
        since = [
            onnx.defs.get_schema(node.op_type, opset.version).since_version
            for node in nodes
            if node.domain == "" and onnx.defs.has(node.op_type, opset.version)
        ]
        if opset.domain == "" and max(since, default=0) <= NEWEST_OPSET:
            opset.version = min(opset.version, NEWEST_OPSET)


def run(model: onnx.ModelProto, inputs: Sequence[Any]) -> list[Any]:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    quiet = onnxruntime.RunOptions()
    quiet.log_severity_level = 4
    ports = session.get_inputs()
    feeds = {
        port.name: np.asarray(value) if isinstance(value, np.generic) else value
        for port, value in zip(ports, inputs, strict=True)
        if value is not None
    }
    return list(session.run(None, feeds, quiet))


def differs(case: Case, found: Sequence[Any], wanted: Sequence[Any]) -> str | None:
    for got, expected in zip(found, wanted, strict=True):
        if isinstance(expected, list):
            pairs = list(zip(got, expected, strict=True))
        else:
            pairs = [(got, expected)]
        for left, right in pairs:
            if reason := _unlike(case, np.asarray(left), np.asarray(right)):
                return reason
    return None


def _unlike(case: Case, left: Any, right: Any) -> str | None:
    if left.dtype.kind in "OUS" or right.dtype.kind in "OUS":
        same = left.astype(str).tolist() == right.astype(str).tolist()
        return None if same else "other strings"
    if left.shape != right.shape or left.dtype != right.dtype:
        return f"{left.dtype}{left.shape} instead of {right.dtype}{right.shape}"
    close = np.allclose(left, right, case.rtol, case.atol, equal_nan=True)
    return None if close else f"{left.reshape(-1)[:4]} not {right.reshape(-1)[:4]}"


def bake(case: Case, inputs: Sequence[Any]) -> onnx.ModelProto | None:
    """Make initializers of the inputs; None where one is no plain tensor."""
    baked = onnx.ModelProto()
    if case.model is not None:
        baked.CopyFrom(case.model)
    for port, value in zip(baked.graph.input, inputs, strict=False):
        if isinstance(value, onnx.TensorProto):
            tensor = onnx.TensorProto()
            tensor.CopyFrom(value)
            tensor.name = port.name
        elif isinstance(value, np.ndarray | np.generic):
            tensor = onnx.numpy_helper.from_array(np.asarray(value), port.name)
        else:
            return None
        baked.graph.initializer.append(tensor)
    del baked.graph.input[:]
    return baked


def check_all(*, baked: bool) -> Outcome:
    outcome = Outcome()
    for case in load_cases():
        for inputs, wanted in case.data_sets or ():
            model = bake(case, inputs) if baked else case.model
            _check(case, model, [] if baked else inputs, wanted, outcome)
    return outcome


def _check(
    case: Case,
    model: onnx.ModelProto | None,
    feeds: Sequence[Any],
    wanted: Sequence[Any],
    outcome: Outcome,
) -> None:
    try:
        if model is None or differs(case, run(model, feeds), wanted):
            outcome.excepted.append(case.name)
            return
    except FAILURES:
        outcome.excepted.append(case.name)
        return
    after = ir.from_proto(model)
    for node in after.graph.all_nodes():
        provenance.stamp(node, provenance.Provenance("all", (node.name or "",)))
    for current in PASSES:
        result = current.run(after, NO_MODULES)
        outcome.folded += bool(result.changes and current.name == "fold-constants")
        after = result.model
    try:
        reason = differs(case, run(ir.to_proto(after), feeds), wanted)
    except FAILURES as error:
        reason = f"{type(error).__name__} {str(error).splitlines()[0][:160]}"
    if provenance.missing(after):
        reason = f"{provenance.missing(after)[0]} has lost its past"
    if reason is None:
        outcome.passed += 1
    else:
        outcome.failed.append(f"{case.name}: {reason}")


@pytest.fixture(scope="module")
def plain() -> Outcome:
    return check_all(baked=False)


@pytest.fixture(scope="module")
def baked() -> Outcome:
    return check_all(baked=True)


def test_outputs_stay_as_they_are(plain: Outcome) -> None:
    assert plain.failed == []


def test_outputs_stay_with_inputs_baked_in(baked: Outcome) -> None:
    assert baked.failed == []


def test_what_onnxruntime_cannot_run_does_not_grow(plain: Outcome) -> None:
    """Counted with onnx 1.23 and onnxruntime 1.31."""
    assert len(plain.excepted) <= 455


def test_baked_exceptions_do_not_grow(baked: Outcome) -> None:
    """More than plain ones: sequences and optionals cannot be initializers."""
    assert len(baked.excepted) <= 477


def test_baked_cases_are_folded(baked: Outcome) -> None:
    assert baked.folded >= 1361
