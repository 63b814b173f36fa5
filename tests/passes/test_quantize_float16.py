"""Int8 beside float16: scales in float16, or a refusal that names the way out."""

import re
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import PreconditionError
from me2e_compress.fidelity.compare import compare
from me2e_compress.passes import Context
from me2e_compress.passes.convert_float16 import ConvertFloat16
from me2e_compress.passes.convert_float32 import ConvertFloat32
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.session import Session
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.testing import check_pass
from tests.frames import record
from tests.nets import MODULES, conv_attention

PAPER = QuantizeInt8(rules="paper", target="tensorrt")


@pytest.fixture
def context(tmp_path: Path) -> Context:
    drawn = np.random.default_rng(1)
    shapes = {"image": (1, 3, 8, 8), "memory": (1, 8, 64)}
    frame = {n: drawn.standard_normal(s).astype(np.float32) for n, s in shapes.items()}
    folder = record(tmp_path / "frames", [frame, frame], scenes=(0, 1))
    return Context(MODULES, CalibrationSet(folder))


def half(opset: int, context: Context) -> ir.Model:
    source = conv_attention()
    source.opset_imports[""] = opset
    return check_pass(ConvertFloat16(), source, context).model


def scales(model: ir.Model) -> set[str]:
    return {
        node.inputs[1].dtype.name
        for node in model.graph
        if node.op_type == "DequantizeLinear"
        and node.inputs[1] is not None
        and node.inputs[1].dtype is not None
    }


def test_scales_are_of_the_type_of_the_graph(context: Context) -> None:
    source = half(19, context)
    placed = check_pass(PAPER, source, context).model

    assert scales(placed) == {"FLOAT16"}
    assert TensorRT(version="10.7").lint(placed) == ()
    found = compare(Session(source), Session(placed), list(context.frames or ()))
    assert min(each.sqnr_db for each in found.outputs) > 20


def test_int8_first_and_float16_then_gives_the_same_types(context: Context) -> None:
    source = conv_attention()
    source.opset_imports[""] = 19
    int8 = check_pass(PAPER, source, context).model
    both = check_pass(ConvertFloat16(), int8, context).model

    assert scales(both) == {"FLOAT16"}
    assert TensorRT(version="10.7").lint(both) == ()
    weights = {v.dtype.name for v in both.graph.initializers.values() if v.dtype}
    assert weights == {"FLOAT16", "INT8", "INT64"}


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("tensorrt", "float16 scales need opset 19, the graph is of 17"),
        ("onnxruntime", "onnxruntime has int8 kernels for float32 alone"),
    ],
)
def test_the_refusal_names_the_way_out(
    target: str, reason: str, context: Context
) -> None:
    step = QuantizeInt8(rules="paper", target=target)

    with pytest.raises(PreconditionError, match=re.escape(reason)) as raised:
        check_pass(step, half(17, context), context)
    assert "put convert-float32 before quantize-int8" in str(raised.value)


def test_the_way_out_leads_out(context: Context) -> None:
    wide = check_pass(ConvertFloat32(), half(17, context), context).model
    step = QuantizeInt8(rules="paper", target="onnxruntime")

    assert check_pass(step, wide, context).changes == 2  # Conv and Linear
