from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import (
    FramesError,
    Me2eError,
    PreconditionError,
)
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager
from me2e_compress.manager.report import Report
from me2e_compress.passes import Context
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.freeze_inputs import FreezeInputs, advice
from tests.passes.small import compute, ops, read
from tests.support.frames import record

NET = """g (float[cameras,2,2] lidar2img, float[3,2] x) => (float[cameras,3,2] y) {
    pillars = MatMul(points, lidar2img)
    seen = Relu(pillars)
    y = Add(seen, x)
}"""
RANDOM = np.random.default_rng(2)
RIG = RANDOM.standard_normal((2, 2, 2)).astype(np.float32)


def net() -> ir.Model:
    model = read(NET, points=RANDOM.standard_normal((3, 2)).astype(np.float32))
    graph.infer_shapes(model)
    return model


def frames(folder: Path, *rigs: Any) -> CalibrationSet:
    recorded = [
        {"lidar2img": rig, "x": RANDOM.standard_normal((3, 2)).astype(np.float32)}
        for rig in rigs
    ]
    return CalibrationSet(record(folder, recorded))


def run(model: ir.Model, recorded: CalibrationSet | None, **options: Any) -> Report:
    passes = (FreezeInputs(**options), FoldConstants())
    return PassManager(passes).run(model, Context(ModuleMap.whole(), recorded))


def test_geometry_is_computed_once(tmp_path: Path) -> None:
    recorded, model = frames(tmp_path / "a", RIG, RIG), net()
    result = run(model, recorded).model
    context = Context(ModuleMap.whole(), recorded)
    assert FreezeInputs().run(result, context).changes == 0
    recorded.check(result)
    with pytest.raises(FramesError, match="lidar2img is not the one"):
        frames(tmp_path / "b", RIG + 1).check(result)  # of another vehicle
    assert ops(result) == ["Add"]
    assert [value.name for value in result.graph.inputs] == ["x"]
    x = recorded[1].arrays["x"]
    np.testing.assert_allclose(
        compute(result, {"x": x}), compute(model, {"x": x, "lidar2img": RIG}), rtol=1e-6
    )


REFUSED: dict[str, tuple[Any, dict[str, Any], type[Me2eError], str]] = {
    "moved": ((RIG, RIG + 1), {}, FramesError, "frame 1 has another lidar2img"),
    "unknown": ((RIG,), {"inputs": ("rig",)}, PreconditionError, "no input is called"),
    "type": ((RIG.astype(np.float64),), {}, FramesError, "is float64"),
    "shape": ((RIG[0],), {}, FramesError, r"shape \[2, 2\]"),
    "nan": ((RIG * np.float32("nan"),), {}, FramesError, "has another lidar2img"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_named(case: str, tmp_path: Path) -> None:
    rigs, options, error, message = REFUSED[case]
    with pytest.raises(error, match=message):
        run(net(), frames(tmp_path, *rigs), **options)


def test_neither_frames_nor_inputs(tmp_path: Path) -> None:
    other = CalibrationSet(record(tmp_path, [{"other": RIG}]))
    with pytest.raises(FramesError, match="frame 0: lidar2img is missing"):
        run(net(), other)
    with pytest.raises(FramesError, match="--frames"):
        run(net(), None)
    assert FreezeInputs().needs_frames


@pytest.mark.parametrize(
    ("read", "names"),
    [
        # of a rate, moved and compared; of two flags; of what is too large to be one
        ("r = Squeeze(rate) c = Equal(r, two)", ("rate",)),
        ("r = And(flag, other) c = Identity(r)", ("flag", "other")),
        ("s = ReduceMax<keepdims=0>(x) c = Greater(s, one)", ()),
        # the size of an input is no value, nor is a state a constant
        ("n = Size(rate) c = Equal(n, two)", ()),
        ("s = ReduceMax<keepdims=0>(prev_y) c = Greater(s, one)", ()),
    ],
)
def test_inputs_of_conditions_are_named(read: str, names: tuple[str, ...]) -> None:
    text = f"""g (int64[1] rate, bool flag, bool other, float[4,9] x, float[4] prev_y)
        => (float[4] next_y) <int64 two = {{2}}, float one = {{1}}> {{
        {read}
        next_y = If(c) <then_branch = a () => (float[4] t) {{ t = Neg(prev_y) }},
                   else_branch = b () => (float[4] e) {{ e = Abs(prev_y) }}>
    }}"""
    model = ir.from_onnx_text(f'<ir_version: 9, opset_import: ["" : 17]>{text}')

    advised = advice(model)

    assert (f"freeze-inputs{{inputs=[{','.join(names)}]}}" in advised) == bool(names)
    assert bool(advised) == bool(names)


def test_matrices_of_a_projection_are_named() -> None:
    model = ir.from_onnx_text("""<ir_version: 9, opset_import: ["" : 17]>
        g (float[6,4,4] rig, float[900,4] points, float[4,4] w) => (float[6,900,4] y)
        { t = Transpose<perm=[0,2,1]>(rig) p = MatMul(points, w) y = MatMul(p, t) }""")
    weight = model.graph.inputs.pop()
    weight.const_value = ir.tensor(np.ones((4, 4), np.float32), name="w")
    model.graph.register_initializer(weight)

    assert "inputs=[rig]" in advice(model)
