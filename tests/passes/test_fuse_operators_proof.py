"""What ``fuse-operators`` finds is proven, or stays."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from me2e_compress.errors import RecipeError
from me2e_compress.graph import digest, infer_shapes
from me2e_compress.manager import PassManager, recipe
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.passes.fuse_operators import FuseOperators, numeric_check
from tests.passes.decomposed import FUSED, Sizes, decomposed, inferred
from tests.passes.small import NO_MODULES, ops, read


def test_what_the_body_does_not_agree_with_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = DeformableAttention.body

    def wrong(self: Any, call: Any, inputs: Any, attributes: Any) -> Any:
        result = right(self, call, inputs, attributes)
        return call.add("Mul", [result, call.numbers(1.01, result)])

    monkeypatch.setattr(DeformableAttention, "body", wrong)
    model = inferred(decomposed(Sizes()))
    before = digest(model)
    result = FuseOperators().run(model, NO_MODULES)
    assert result.changes == 0
    assert digest(model) == before
    assert all("differs by 1.0e-02" in note for note in result.notes)
    assert len(result.notes) == len(Sizes().levels)


TWICE = """<ir_version: 9, opset_import: ["" : 17]>
g (float[1,4,5,7] image, float[1,9,3,2] grid, float[3] weights)
  => (float[1,4,9] y, float[1,4,9] z) <int64[1] last = {-1}> {
    s = GridSample(image, grid)
    m = Mul(s, weights)
    y = ReduceSum<keepdims = 0>(m, last)
    deeper = Neg(image)
    t = GridSample(deeper, grid)
    n = Mul(t, weights)
    z = ReduceSum<keepdims = 0>(n, last)
}"""


def test_pieces_that_are_alike_are_proven_once(monkeypatch: pytest.MonkeyPatch) -> None:
    runs, run = [], numeric_check.run_piece

    def counted(piece: Any, given: Any) -> Any:
        runs.append(piece)
        return run(piece, given)

    monkeypatch.setattr(numeric_check, "run_piece", counted)
    assert FuseOperators().run(inferred(read(TWICE)), NO_MODULES).changes == 2
    assert len(runs) == 2


def test_the_way_to_a_plugin_of_tensorrt_is_checked() -> None:
    passes = recipe.parse("fuse-operators,translate-plugins{dialect=tensorrt}")
    model = decomposed(Sizes(n=3), merge="ReduceSum", masked=True)
    report = PassManager(passes).run(model, NO_MODULES)
    (found,) = report.verifications
    assert found.passes == ("fuse-operators", "translate-plugins")
    assert found.errors["y"] < 1e-4
    assert "MultiscaleDeformableAttnPlugin_TRT" in ops(report.model)


@pytest.mark.parametrize("tolerance", [0.0, 1.0, -1e-4, float("nan")])
def test_a_tolerance_that_is_none_is_refused(tolerance: float) -> None:
    with pytest.raises(RecipeError, match="tolerance"):
        FuseOperators(tolerance=tolerance)


def test_a_proof_is_no_zero_against_a_zero() -> None:
    # With this seed the only position drawn first lies outside of the feature map.
    model = decomposed(Sizes(n=1, q=1, m=1, p=1, d=1, levels=((2, 3),)))
    infer_shapes(model)
    with np.errstate(invalid="raise"):
        FuseOperators().run(model, dataclasses.replace(NO_MODULES, seed=7))
    assert FUSED in ops(model)
