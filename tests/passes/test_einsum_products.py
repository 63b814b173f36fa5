"""Einsums and weights in front become layers that answer the same."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.passes import Context
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.runtime.session import run_once
from tests.passes.small import ops

SIZES = dict(zip("abcdehnm", (2, 3, 4, 5, 6, 2, 7, 8), strict=True))


def einsum(equation: str, *, open_batch: bool = False) -> ir.Model:
    left, right, out = equation.replace("->", ",").replace(" ", "").split(",")
    shapes = [
        ",".join("?" if open_batch and x == "b" else str(SIZES[x]) for x in labels)
        for labels in (left, right, out)
    ]
    return ir.from_onnx_text(
        f"""<ir_version: 9, opset_import: ["" : 17]>
        g (float[{shapes[0]}] x, float[{shapes[1]}] w) => (float[{shapes[2]}] y) {{
            ["sum"] y = Einsum <equation: string = "{equation}"> (x, w)
        }}"""
    )


def normalise(model: ir.Model) -> None:
    ImportNormalize().run(model, Context(ModuleMap.whole()))


def compare(model: ir.Model, *shapes: tuple[int, ...]) -> None:
    random = np.random.default_rng(5)
    feeds = {
        str(port.name): random.normal(size=shape).astype(np.float32)
        for port, shape in zip(model.graph.inputs, shapes, strict=True)
    }
    before = run_once(model, feeds)["y"]
    normalise(model)
    assert "Einsum" not in ops(model)
    after = run_once(model, feeds)["y"]
    assert np.abs(after.astype(np.float64) - before.astype(np.float64)).max() < 1e-5


@pytest.mark.parametrize(
    "equation",
    [
        "bnc,cd->bnd", "bnd,ed->bne", "bnd,bmd->bnm", "bnm,bmd->bnd", "bhnd,bhmd->bhnm",
        "bcnm,cd->bdnm", "bnhd,hde->bne", "nd , bmd->bnm", "bnd,bmd->mbn",
        "nbd,bde->nbe", "bnhd,bmhd->bhnm", "ncd,de->enc",
    ],
)  # fmt: skip
def test_a_product_of_two_operands_is_a_matmul(equation: str) -> None:
    model = einsum(equation)
    left, right = equation.replace(" ", "").partition("->")[0].split(",")
    shapes = (tuple(SIZES[x] for x in labels) for labels in (left, right))
    compare(model, *shapes)


@pytest.mark.parametrize(
    "equation", ["bnd,bnd->bn", "bn,cm->bncm", "bnd,md->bn", "bbd,de->be", "bnd,de->bd"]
)
def test_what_is_no_product_stays(equation: str) -> None:
    model = einsum(equation)
    normalise(model)
    assert ops(model) == ["Einsum"]


def test_an_open_axis_is_no_obstacle_where_nothing_is_reshaped() -> None:
    compare(einsum("bnc,cd->bnd", open_batch=True), (3, 7, 4), (4, 5))
    model = einsum("bnhd,hde->bne", open_batch=True)
    normalise(model)
    assert ops(model) == ["Einsum"]


@pytest.mark.parametrize("shape", [(4, 7), (2, 4, 7)])
def test_a_weight_in_front_of_columns_is_a_convolution(shape: tuple[int, ...]) -> None:
    model = ir.from_onnx_text(
        f"""<ir_version: 9, opset_import: ["" : 17]>
        g (float[{",".join(map(str, shape))}] x) => (float y)
        <float[3,4] w = {{1,2,3,4,5,6,7,8,9,1,2,3}}> {{ ["p"] y = MatMul(w, x) }}"""
    )
    compare(model, shape)
    assert ops(model) == ["Conv" if len(shape) == 3 else "MatMul"]
