"""``fuse-kernels`` on the positions and weights of deformable attention."""

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.graph import array_of, infer_shapes, opset_of, static_shape
from me2e_compress.operators import expand
from me2e_compress.passes.fuse_kernels import FuseKernels
from tests.passes.small import apply, compute, read
from tests.support.profiles import scaled

RAW, OWN = "RawDeformableAttention", "MultiScaleDeformableAttention"


@dataclasses.dataclass(frozen=True)
class Case:
    """Sizes of an attention of cameras that share offsets, and how it is written."""

    batch: int = 1
    queries: int = 5
    heads: int = 2
    cameras: int = 2
    levels: int = 2
    pillars: int = 2
    each: int = 2
    over_levels: bool = True
    masked: bool = True
    scale: float = 0.5

    @property
    def points(self) -> int:
        return self.pillars * self.each


def model_of(c: Case, *, also: str = "") -> ir.Model:
    """Write it as BEVFormer's camera attention is exported: sums of five axes."""
    n, q, m, cams, k, p = c.batch, c.queries, c.heads, c.cameras, c.levels, c.points
    row = f"{n}, {q}, {m}, {k * p}" if c.over_levels else f"{n}, {q}, {m}, {k}, {p}"
    full = f"{n}, {q}, {m}, {cams * k}, {p}"
    around = f"{n}, {q}, {m}, 1, {k}, {c.each}, {c.pillars}, 2"
    factor = "shown = Mul(parted, seen)" if c.masked else "shown = Expand(parted, six)"
    shapes = {
        "near_of": f"{n}, {q}, 1, {cams}, 1, 1, {c.pillars}, 2",
        "away_of": around,
        "at_of": f"{full}, 2",
        "row_of": row,
        "parted_of": f"{n}, {q}, {m}, 1, {k}, {p}",
        "seen_of": f"{n}, {q}, 1, {cams}, 1, 1",
        "six": f"{n}, {q}, {m}, {cams}, {k}, {p}",
        "full": full,
    }
    stored = ", ".join(
        f"int64[{len(dims.split(','))}] {name} = {{{dims}}}"
        for name, dims in shapes.items()
    )
    outputs = "".join(f", double {name}" for name in also.split())
    model = read(f"""
        <ir_version: 8, opset_import: ["" : 17, "me2e" : 1]>
        one (double[{n},{6 * cams * k},{m},3] value, int64[{cams * k},2] sizes,
             int64[{cams * k}] starts, double[{cams},{n},{q},{c.pillars},2] points,
             double[{n},{q},{m * k * p * 2}] moved, double[{n},{q},{m * k * p}] scores,
             double[{cams},{n},{q}] mask)
            => (double[{n},{q},{m},3] y{outputs})
        <{stored}, double scale = {{{c.scale}}}> {{
            turned = Transpose<perm = [1, 2, 0, 3, 4]>(points)
            near = Reshape(turned, near_of)
            away = Reshape(moved, away_of)
            sum = Add(near, away)
            at = Reshape(sum, at_of)
            rows = Reshape(scores, row_of)
            soft = Softmax<axis = -1>(rows)
            parted = Reshape(soft, parted_of)
            first = Transpose<perm = [1, 2, 0]>(mask)
            seen = Reshape(first, seen_of)
            {factor}
            joined = Reshape(shown, full)
            weights = Mul(joined, scale)
            y = me2e.MultiScaleDeformableAttention(value, sizes, starts, at, weights)
        }}
    """)
    infer_shapes(model)
    return model


def feeds(c: Case, model: ir.Model) -> dict[str, npt.NDArray[Any]]:
    random, count = np.random.default_rng(3), c.cameras * c.levels
    drawn: dict[str, npt.NDArray[Any]] = {
        str(port.name): random.normal(size=static_shape(port)) * 0.4
        for port in model.graph.inputs
    }
    tables = {"sizes": np.array([[2, 3]] * count), "starts": np.arange(count) * 6}
    return drawn | tables


def outputs(c: Case, model: ir.Model) -> list[npt.NDArray[Any]]:
    """Run it with bodies; sizes are inputs, so these are of Gather, also in float64."""
    whole = model.clone()
    for node in [node for node in whole.graph if node.domain == "me2e"]:
        expand(node, opset=opset_of(whole), by="test")
    return compute(whole, feeds(c, model))


def fused(c: Case, model: ir.Model) -> list[ir.Node]:
    """Fuse, check the outputs to rounding, and return the fused nodes."""
    before = outputs(c, model)
    apply(FuseKernels(), model)
    for want, got in zip(before, outputs(c, model), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-12)
    return [node for node in model.graph if node.domain == "me2e"]


@settings(max_examples=scaled(5))
@given(
    case=st.builds(
        Case,
        batch=st.integers(1, 2),
        queries=st.integers(2, 4),
        heads=st.integers(2, 3),
        cameras=st.integers(1, 3),
        levels=st.integers(1, 3),
        pillars=st.integers(1, 2),
        each=st.integers(1, 2),
        over_levels=st.booleans(),
        masked=st.booleans(),
        scale=st.sampled_from([1.0, 0.5]),
    ).filter(lambda case: case.points > 1)
)
def test_operands_are_read_before_they_are_repeated(case: Case) -> None:
    (node,) = fused(case, model_of(case))

    assert node.op_type == RAW
    counts = [math.prod(static_shape(value) or ()) for value in node.inputs[3:]]
    c, rows = case, case.batch * case.queries
    scores = rows * c.heads * c.levels * c.points
    near, mask = 2 * rows * c.cameras * c.pillars, rows * c.cameras
    assert counts == [near, 2 * scores, scores, mask if c.masked else 1]


@pytest.mark.parametrize(("each", "kind"), [(1, OWN), (2, RAW)])
def test_one_point_of_a_level_does_not_pay(each: int, kind: str) -> None:
    case = Case(pillars=1, each=each)

    (node,) = fused(case, model_of(case))

    assert node.op_type == kind


@pytest.mark.parametrize(
    ("also", "plain"), [("sum", [3]), ("soft", [5]), ("shown", [5]), ("sum soft", [])]
)
def test_what_others_read_too_stays(also: str, plain: list[int]) -> None:
    case = Case()
    (node,) = fused(case, model_of(case, also=also))

    assert node.op_type == (RAW if plain else OWN)
    constant = [i for i in range(3, len(node.inputs)) if zeros(node.inputs[i])]
    assert constant == plain


def zeros(value: ir.Value | None) -> bool:
    known = array_of(value)
    return known is not None and not known.any()
