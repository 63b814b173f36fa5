from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError, Me2eError, PreconditionError, RecipeError
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager
from me2e_compress.manager.report import Report
from me2e_compress.passes import Context
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.freeze_inputs import FreezeInputs
from tests.frames import record
from tests.passes.small import compute, ops, read

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
    with pytest.raises(RecipeError, match="needs inputs"):
        FreezeInputs(inputs=())
