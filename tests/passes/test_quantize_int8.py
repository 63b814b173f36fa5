"""Int8 where a plan says so, of float32 and of float16, and lowered for a CPU."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import (
    FramesError,
    ModuleMapError,
    PreconditionError,
    RecipeError,
)
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.fidelity.compare import compare
from me2e_compress.graph import provenance
from me2e_compress.manager import PassManager
from me2e_compress.passes import Context
from me2e_compress.passes.convert_float16 import ConvertFloat16
from me2e_compress.passes.convert_float32 import ConvertFloat32
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.decision import plan_of
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime.convert import int8_layers, unranged
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.testing import check_pass
from tests.support.frames import record
from tests.support.nets import MODULES, conv_attention, image, net, parsed

PAPER = QuantizeInt8(rules="paper", target="tensorrt")
TENSORS = ("image", "q", "seen", "p", "mixed")


@pytest.fixture
def frames(tmp_path: Path) -> CalibrationSet:
    return CalibrationSet(record(tmp_path / "f", [image(i) for i in range(4)], (0, 2)))


@pytest.fixture
def context(frames: CalibrationSet) -> Context:
    return Context(MODULES, frames)


def test_the_quantized_graph_runs_stays_close_and_carries_its_plan(
    context: Context, frames: CalibrationSet
) -> None:
    model = conv_attention()

    result = PAPER.run(model, context)
    found = compare(Session(model), Session(result.model), frames)

    assert result.changes == 4
    # 8 bits give about 6 dB each; two attention products and two layers cost some
    assert all(20 < each.sqnr_db < 60 for each in found.outputs)
    plan = plan_of(result.model)
    assert plan is not None
    assert (plan.rules, plan.target) == ("paper", "tensorrt")
    assert len(plan.decisions) == 10


SAFE = {"target": "tensorrt"}


@pytest.mark.parametrize(
    ("options", "notes"),
    [
        (
            SAFE | {"rules": "paper{attention_limit=8}"},
            [
                "for tensorrt: 2 of 10 nodes int8; attention-length 2, layer 2",
                "2 tensors calibrated on 4 frames",
            ],
        ),
        (SAFE, ["1 of 10 nodes int8; attention-weights 2, layer 1, small-product 1"]),
        (
            SAFE | {"rules": "safe{without=[small-product, attention-weights]}"},
            ["4 of 10 nodes int8; attention 2, layer 2"],
        ),
    ],
)
def test_notes_say_what_was_decided_by_which_rule(
    context: Context, options: dict[str, object], notes: list[str]
) -> None:
    chosen = QuantizeInt8(**options)  # type: ignore[arg-type]

    message = chosen.run(conv_attention(), context).notes
    assert [any(note in line for line in message) for note in notes] == [True] * len(
        notes
    )


def test_unfit_frames_and_graphs_are_refused(context: Context, tmp_path: Path) -> None:
    bare, model = Context(MODULES), conv_attention()
    with pytest.raises(FramesError, match=r"needs recorded frames .* never made up"):
        QuantizeInt8(rules="paper").run(model, bare)
    other = CalibrationSet(record(tmp_path, [{"lidar": np.zeros(3, np.float32)}]))
    with pytest.raises(FramesError, match=r"input image is missing.*lidar"):
        QuantizeInt8(rules="paper").run(model, Context(MODULES, other))
    with pytest.raises(PreconditionError, match="no quantized activation"):
        LowerInt8().run(model, context)
    with pytest.raises(FramesError, match=r"lower-int8 needs recorded .* never made"):
        LowerInt8().run(PAPER.run(model, context).model, bare)


def test_what_is_quantized_while_it_runs_is_not_lowered(context: Context) -> None:
    model = parsed(
        """
        g (float[2,4] x) => (int32[2,3] y) <int8[4,3] w = {1,2,3,4,5,6,7,8,9,1,2,3}> {
            q, s, z = DynamicQuantizeLinear(x)
            y = MatMulInteger(q, w, z)
        }"""
    )
    with pytest.raises(PreconditionError, match=r"graph that it was made of$"):
        QuantizeInt8().run(model, context)


def test_a_quantized_graph_is_not_quantized_again(context: Context) -> None:
    # its plan has decided of the layers, too, that are float
    half = dataclasses.replace(PAPER, scheme=("backbone",))
    once = half.run(conv_attention(), context).model

    with pytest.raises(PreconditionError) as caught:
        PAPER.run(once, context)

    message = str(caught.value)
    assert "quantized already: 2 DequantizeLinear, 1 QuantizeLinear" in message
    assert "int8 with zero points 0; it carries the plan it was made by" in message


PARTLY = """
<ir_version: 13, opset_import: ["" : 25]>
partly (float[1,3,8,8] image, packed[8,3,3,3] q, float[8,8,1,1] w, float[8,8,1,1] v)
    => (float[1,8,6,6] y) <float half = {0.5}, int8 zero = {0}> {
    i = QuantizeLinear(image, half, zero)
    d = DequantizeLinear(i, half, zero)
    ["/backbone/A"] %s
    ["/backbone/B"] b = Conv(a, w)
    %s
}
"""
PACKED = {
    "weights": "p = DequantizeLinear(q, half) a = Conv(image, p)",
    "moved": "f = DequantizeLinear(q, half) u = Transpose<perm=[0,1,3,2]>(f)"
    " p = Mul(u, half) a = Conv(image, p)",
    "activations": "p = Cast<to=1>(q) n = Identity(d) a = Conv(n, p)",
}


@pytest.mark.parametrize("target", ["onnxruntime", "tensorrt"])
@pytest.mark.parametrize(
    ("packed", "form"),
    [
        *((kind, "weights") for kind in ("INT4", "UINT4", "INT2", "UINT2", "INT8")),
        *(("INT4", "moved"), ("INT8", "activations")),
    ],
)
def test_what_is_quantized_already_stays_and_the_rest_becomes_int8(
    packed: str, form: str, target: str, context: Context, frames: CalibrationSet
) -> None:
    model = partly(packed, form, "r = Conv(b, v) s = QuantizeLinear(b, half, zero)"
        " t = DequantizeLinear(s, half, zero) y = Add(r, t)")  # fmt: skip
    result = QuantizeInt8(rules="paper", target=target).run(model, context)

    plan = plan_of(result.model)
    assert plan is not None
    stays, *others = (each for each in plan.decisions if each.op in ("Conv", "Add"))
    assert stays.reason == f"quantized already: it reads {packed.lower()}"
    # nor is a branch put in pairs that comes out of one
    assert [each.dtype for each in others] == ["int8", "int8", "float"]
    stored = result.model.graph.initializers["q"].const_value
    assert stored is not None
    assert stored.dtype == ir.DataType[packed]
    (found,) = compare(Session(model), Session(result.model), frames).outputs
    assert found.sqnr_db > 20


def partly(packed: str, form: str, end: str) -> ir.Model:
    """A layer that is quantized by its weight or input, before a float one."""
    generator = np.random.default_rng(0)
    shapes = {"q": (8, 3, 3, 3), "w": (8, 8, 1, 1), "v": (8, 8, 1, 1)}
    arrays = {name: generator.normal(size=shape) for name, shape in shapes.items()}
    text = PARTLY % (PACKED[form], end)
    model = net(text.replace("packed", packed.lower()), arrays)
    whole = np.clip(np.round(arrays["q"]), 0 if packed[0] == "U" else -2, 1)
    kind = ir.DataType[packed]
    value = model.graph.initializers["q"]
    value.const_value = ir.tensor(whole.astype(kind.numpy()), kind, name="q")
    value.type = ir.TensorType(kind)
    graph.infer_shapes(model)
    return model


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"scheme": "fp8"}, RecipeError, "no scheme fp8; there are feature-ext"),
        ({"scheme": ("occ",)}, ModuleMapError, "occ: no such module"),
        ({"rules": "safe{without=[speed]}"}, RecipeError, "speed cannot be switched "),
        ({"rules": "int4"}, RecipeError, "no rule set 'int4'; there are safe, paper"),
        ({"target": "qnn"}, RecipeError, "no target 'qnn'; there are tensorrt"),
        ({"overrides": Path("none.toml")}, RecipeError, "none.toml: no such file"),
        ({"method": "median", "rules": "paper"}, RecipeError, "no calibration method"),
    ],
)
def test_what_is_not_there_is_named(
    context: Context, options: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        QuantizeInt8(**options).run(conv_attention(), context)  # type: ignore[arg-type]


def test_saved_ranges_give_the_same_graph_without_frames(
    context: Context, frames: CalibrationSet, tmp_path: Path
) -> None:
    model = conv_attention()
    path = tmp_path / "r.json"
    Calibrator("max-min").run(model, TENSORS, frames).save(path)

    measured = PAPER.run(conv_attention(), context).model
    saved = QuantizeInt8(rules="paper", target="tensorrt", ranges=path)
    read = saved.run(model, Context(MODULES)).model

    assert graph.digest(read) == graph.digest(measured)


@pytest.mark.parametrize(
    ("options", "method"),
    [
        ({}, "mse"),
        ({"rules": "safe{without=[cost]}"}, "mse"),
        ({"rules": "paper"}, "max-min"),
        ({"rules": "paper", "method": "percentile:99"}, "percentile:99"),
    ],
)
def test_the_rules_choose_the_method_unless_it_is_asked_for(
    options: dict[str, str], method: str
) -> None:
    assert QuantizeInt8(**options).method_of_ranges == method  # type: ignore[arg-type]


def test_layers_that_the_target_keeps_in_float_do_not_count(context: Context) -> None:
    paper = QuantizeInt8(rules="paper", target="onnxruntime")
    result = paper.run(conv_attention(), context)

    assert result.changes == len(int8_layers(result.model)) == 2
    with pytest.raises(PreconditionError, match="only symmetric int8"):
        LowerInt8().run(result.model, context)
    assert "2 of them stay float on their target" in result.notes[0]
    plan = plan_of(result.model)
    assert plan is not None
    assert (len(plan.chosen), len(plan.placed)) == (4, 2)


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


def test_scales_of_a_float16_graph_are_float16(context: Context) -> None:
    wide = half(19, context)
    placed = check_pass(PAPER, wide, context).model
    result = compare(Session(wide), Session(placed), list(context.frames or ()))
    assert min(each.sqnr_db for each in result.outputs) > 20
    source = conv_attention()
    source.opset_imports[""] = 19
    int8 = check_pass(PAPER, source, context).model
    both = check_pass(ConvertFloat16(), int8, context).model

    for made in (placed, both):
        assert scales(made) == {"FLOAT16"}
        assert TensorRT(version="10.7").lint(made) == ()
    weights = {v.dtype.name for v in both.graph.initializers.values() if v.dtype}
    assert weights == {"FLOAT16", "INT8", "INT64"}


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("tensorrt", "float16 scales need opset 19, the graph is of 17"),
        ("onnxruntime", "onnxruntime has int8 kernels for float32 alone"),
    ],
)
def test_refusals_name_the_remedy(target: str, reason: str, context: Context) -> None:
    step = QuantizeInt8(rules="paper", target=target)

    with pytest.raises(PreconditionError, match=re.escape(reason)) as raised:
        check_pass(step, half(17, context), context)
    assert "put convert-float32 before quantize-int8" in str(raised.value)
    wide = check_pass(ConvertFloat32(), half(17, context), context).model
    assert check_pass(step, wide, context).changes > 0


def test_saved_ranges_lower_to_the_same_graph_without_frames(
    context: Context, frames: CalibrationSet, tmp_path: Path
) -> None:
    placed = PAPER.run(conv_attention(), context).model
    path = tmp_path / "r.json"
    Calibrator().run(placed, unranged(placed), frames).save(path)

    measured = LowerInt8().run(placed, context).model
    read = LowerInt8(ranges=path).run(placed, Context(MODULES)).model

    assert graph.digest(read) == graph.digest(measured)


BATCHED = """
batched (float[1,3,8,8] image, float[1,3,8,4] w) => (float[1,3,8,4] y) {
    y = MatMul(image, w)
}
"""


@pytest.mark.parametrize(
    ("model", "changes", "note"),
    [
        (conv_attention(), [4, 2], "2 layers in int8 for onnxruntime"),
        (
            net(BATCHED, {"w": np.random.default_rng(0).normal(size=(1, 3, 8, 4))}),
            [1, 1],  # the pair has no kernel: taken out
            "0 layers in int8 for onnxruntime",
        ),
    ],
)
def test_the_manager_takes_both_passes_in_a_row(
    model: ir.Model, changes: list[int], note: str, context: Context
) -> None:
    report = PassManager((PAPER, LowerInt8()), verify_frames=0).run(model, context)

    assert [step.changes for step in report.steps] == changes
    assert note in report.steps[1].notes
    assert not provenance.missing(report.model)
