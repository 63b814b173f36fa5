"""What a proof by running both graphs covers, and what it says where it covers less."""

import re

import ml_dtypes
import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from me2e_compress.base.errors import VerificationError
from me2e_compress.manager import PassManager, Verification, pass_manager
from me2e_compress.manager.verification_inputs import (
    EQUAL_SIZES,
    VerificationInputs,
    relative_error,
    relative_errors,
    tolerances,
)
from me2e_compress.passes.base import Context, Pass
from me2e_compress.runtime.frames import Frame
from tests.manager import passes

HEAD = '<ir_version: 9, opset_import: ["" : 17]>\n'


def checks(
    text: str, context: Context, *chosen: Pass, frames: int = 2
) -> tuple[Verification, ...]:
    model = ir.from_onnx_text(HEAD + text)
    return PassManager(chosen, frames).run(model, context).verifications


MIXED = """m (float[n,4] x, float[1,8] s) => (float[n,4] y, float[1,8] t)
    <float[4] w = {1.0, 2.0, 3.0, 4.0}> {
    ["/backbone/Mul"] y = Mul(x, w)
    ["/backbone/Neg"] t = Neg(s)
}"""


def test_an_open_dimension_is_run_at_two_sizes(context: Context) -> None:
    (check,) = checks(MIXED, context, passes.ROUNDS)
    assert check.sizes == ({"n": 2}, {"n": 3})
    assert check.inputs_text == "synthetic, n=2 and n=3"
    assert set(check.errors) == {"y", "t"}
    with pytest.raises(VerificationError, match=r"scales promises .* changed y by"):
        checks(MIXED, context, passes.scales(1.01))
    (check,) = checks(MIXED, context, passes.ROUNDS, frames=0)
    assert check.passes == ("import-normalize", "rounds")
    assert check.unproven == "no frame was asked for (--verify-frames 0)"


def test_open_dimensions_are_given_different_sizes(context: Context) -> None:
    text = """m (float[n,4] x, float[m,4] z) => (int64[2] y, float[m,4] u) {
        ["/backbone/Shape"] y = Shape(x)
        ["/backbone/Neg"] u = Neg(z)
    }"""
    with pytest.raises(VerificationError, match="swaps-sizes promises"):
        checks(text, context, passes.SWAPS_SIZES)


@pytest.mark.parametrize(
    ("text", "sizes"),
    [
        # Two inputs that must be as long as each other, whatever they are called.
        (
            """m (float[n,4] x, float[m,4] z) => (float[k,4] y) {
            ["/backbone/Add"] y = Add(x, z)
        }""",
            ({"n": 2, "m": 2}, {"n": 3, "m": 3}),
        ),
        # A picture that is halved four times.
        (
            """m (float[b,1,h,w] x) => (float[b,1,k,l] y) <int64[4] two = {1, 1, 4, 4},
            int64[5] cut = {-1, 1, 4, 4, 1}> {
            ["/backbone/MaxPool"] p = MaxPool<kernel_shape=[4,4], strides=[4,4]>(x)
            ["/backbone/Cut"] c = Reshape(p, cut)
            ["/backbone/Back"] y = Reshape(c, two)
        }""",
            ({"b": 1, "h": 16, "w": 16},),
        ),
    ],
)
def test_sizes_are_drawn_until_the_graph_runs(
    text: str, sizes: tuple[dict[str, int], ...], context: Context
) -> None:
    (check,) = checks(text, context, passes.IDLE)
    assert check.sizes == sizes
    assert check.unproven is None
    assert all(size % 4 == 0 and lead in (1, 2) for lead, size in EQUAL_SIZES[3:])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            """m (float[n,4] x) => (float[7,997] y) <int64[2] odd = {7, 997}> {
            ["/backbone/Reshape"] y = Reshape(x, odd) }""",
            r"runs at none of the sizes that were tried for n \(.*--set-dim",
        ),
        (
            """m (string[2] x) => (string[2] y) {
            ["/backbone/Identity"] y = Identity(x) }""",
            "^input x is STRING: seeded inputs are numbers$",
        ),
        (
            """m (seq(float[2]) x) => (float[2] y) <int64 zero = {0}> {
            ["/backbone/At"] y = SequenceAt(x, zero) }""",
            r"^input x is Sequence\(.*: seeded inputs are numbers$",
        ),
        (
            """m (float[64] x) => (float[64] noise) {
            ["/backbone/Noise"] noise = RandomNormalLike(x) }""",
            "^noise: another at every run$",
        ),
        (
            """m (float[64] x, bool t) => (float[64] y) <float half = {0.5}> {
            ["/backbone/Dropout"] y = Dropout(x, half, t) }""",
            "^y: another at every run$",
        ),
    ],
    ids=["no size", "no numbers", "no tensor", "drawn", "trained"],
)
def test_what_cannot_be_compared_is_not_proven(
    text: str, reason: str, context: Context
) -> None:
    (check,) = checks(text, context, passes.IDLE)
    assert re.search(reason, check.unproven or "")


def test_passes_before_a_graph_could_run_are_not_proven(context: Context) -> None:
    text = """m (float[4] x) => (float[4] y) <float[4] w = {1.0, 2.0, 3.0, 4.0}> {
        ["/backbone/Rotate"] u = NoSuchOperator(x)
        ["/backbone/Mul"] y = Mul(x, w)
    }"""
    first, second = checks(
        text, context, passes.ROUNDS, passes.REMOVES_DEAD, passes.ROUNDS
    )
    assert first.passes == ("import-normalize", "rounds", "remove-dead")
    assert "no operator" in (first.unproven or "")
    assert (second.passes, second.unproven) == (("rounds",), None)


def test_an_output_that_is_drawn_at_every_run_is_named(context: Context) -> None:
    text = """m (float[64] x) => (float[64] noise, float[64] y) {
        ["/backbone/Noise"] r = RandomNormalLike(x)
        ["/backbone/Add"] noise = Add(r, x)
        ["/backbone/Neg"] y = Neg(x)
    }"""
    (check,) = checks(text, context, passes.IDLE)
    assert check.random == ("noise",)
    assert check.judged == ("y",)
    assert check.left_out == "noise: another at every run"


REDUCED = """m (float[1,1,16] x) => (float[1,1,1] y) <int64[1] axes = {2}> {
    ["/backbone/Sum"] y = ReduceSum<keepdims = 1>(x, axes)
}"""


@pytest.mark.parametrize(
    ("axis", "reason"), [(3, "axis must be in"), (0, r"y is \[1,1,16\], not \[1,1,1\]")]
)
def test_a_wrong_axis_is_caught_without_a_run(
    axis: int, reason: str, context: Context
) -> None:
    with pytest.raises(VerificationError, match=rf"leaves left node .*Sum.*{reason}"):
        checks(REDUCED, context, passes.leaves(axis), frames=0)


OVERFLOWS = """m (float[1,1,4,8] x) => (float[1,1,4,8] y)
    <float tiny = {1e-30}, float[1,1,1,1] w = {1e30}, float factor = {1e10}> {
    ["/backbone/Tiny"] t = Mul(x, tiny)
    ["/backbone/Conv"] c = Conv(t, w)
    ["/backbone/Mul"] y = Mul(c, factor)
}"""
"""onnxruntime multiplies the weight by the factor, which float32 does not hold."""


@pytest.mark.parametrize(
    ("text", "where"),
    [
        (OVERFLOWS, "before"),
        (OVERFLOWS.replace("Mul(c", "Div(c").replace("1e10", "1e-10"), "after"),
    ],
)
def test_what_onnxruntime_itself_changes_is_no_fault_of_a_pass(
    text: str, where: str, context: Context
) -> None:
    (check,) = checks(text, context, passes.INVERTS)
    assert check.errors["y"] < 1e-6
    (remark,) = check.remarks
    assert f"another y of the graph {where} the passes where it optimizes" in remark


LINEAR = """linear (float[1,8] x) => (float[1,8] y)
<float[8] w = {1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0}> {
    ["/backbone/Mul"] y = Mul(x, w)
}"""
"""Moves by the share that its weights move by."""


def test_rounding_is_no_breach_of_exactness(context: Context) -> None:
    (check,) = checks(LINEAR, context, passes.scales(1 + 5e-5))
    assert check.errors["y"] == pytest.approx(5e-5, rel=0.01)


@pytest.mark.parametrize("share", [2e-4, 1e-3, 5e-2])
def test_an_exact_pass_must_not_move_an_output_by_a_little(
    share: float, context: Context
) -> None:
    place = r"inputs\); first difference: module backbone, y of /backbone/Mul \(Mul\)"
    words = rf"^scales promises .* changed y by .*{place}"
    with pytest.raises(VerificationError, match=words):
        checks(LINEAR, context, passes.scales(1 + share))


HARD = """hard (float[1,8] x) => (float[1,8] choice, float[1,8] steady)
<float[8] w = {1.5, 2.1, 3.7, 4.3, 5.9, 6.1, 7.7, 8.3}, float k = {1e8}> {
    ["/backbone/Mul"] a = Mul(x, w)
    ["/plan_head/Mul"] b = Mul(a, k)
    ["/plan_head/Sin"] c = Sin(b)
    ["/plan_head/Sign"] choice = Sign(c)
    ["/occ_head/Tanh"] steady = Tanh(a)
}"""
"""``choice`` hangs on the last places of ``x``."""


def test_what_rounding_alone_decides_is_not_held_against_a_pass_and_the_rest_is(
    context: Context,
) -> None:
    (check,) = checks(HARD, context, passes.ROUNDS)
    assert check.unsteady == ("choice",)
    assert check.errors["choice"] > 1.0
    assert 0.0 < check.errors["steady"] < check.tolerances["steady"]
    words = r"^turns-tanh-into-sigmoid promises .* changed steady by"
    with pytest.raises(VerificationError, match=words):
        checks(HARD, context, passes.ROUNDS, passes.TurnsTanhIntoSigmoid())


FLOATS = hnp.arrays(
    np.float32,
    hnp.array_shapes(max_side=4),
    elements=st.floats(-1e6, 1e6, width=32, allow_subnormal=False),
)


@given(FLOATS)
def test_nothing_differs_from_itself(a: np.ndarray) -> None:
    assert relative_error(a, a.copy()) == 0.0
    assert relative_error(a[:0], a[:0]) == 0.0


@given(FLOATS, st.floats(0.0009765625, 0.5, width=32))
def test_the_error_is_relative_to_the_largest(a: np.ndarray, share: float) -> None:
    peak = np.unravel_index(np.abs(a).argmax(), a.shape)
    if abs(a[peak]) < 1e-3:
        return
    b = a.astype(np.float64)
    b[peak] *= 1 + share
    assert relative_error(a.astype(np.float64), b) == pytest.approx(share, rel=1e-9)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (np.zeros(2, np.float32), np.zeros(3, np.float32)),
        (np.zeros(2, np.float32), np.zeros(2, np.float64)),
        (np.zeros(2, np.float32), np.full(2, 1e-30, np.float32)),
        (np.array([1.0, np.nan], np.float32), np.array([1.0, 2.0], np.float32)),
        (np.array([1.0, np.inf], np.float32), np.array([1.0, -np.inf], np.float32)),
        (np.array([1, 2]), np.array([1, 3])),
        (np.array(["a"]), np.array(["b"])),
    ],
)
def test_what_no_number_can_measure_is_infinite(a: np.ndarray, b: np.ndarray) -> None:
    assert relative_error(a, b) == float("inf")


@pytest.mark.parametrize(
    ("dtype", "rounding", "change"),
    [
        ("float64", 5e-10, 2e-9),
        ("float32", 5e-5, 2e-4),
        ("float16", 5e-3, 2e-2),
        ("bfloat16", 2.5e-2, 1e-1),
    ],
)
def test_what_counts_as_rounding_depends_on_the_type(
    dtype: str, rounding: float, change: float
) -> None:
    def is_rounding(share: float) -> bool:
        kind = np.dtype(getattr(ml_dtypes, dtype, dtype))
        a = np.linspace(-0.5, 1.0, 61)
        left, right = {"y": a.astype(kind)}, {"y": (a * (1 + share)).astype(kind)}
        found = relative_errors([left], [right])
        return Verification(("p",), "recorded", found, tolerances(left)).passed

    assert is_rounding(rounding)
    assert not is_rounding(change)


@given(FLOATS, st.integers(0, 9))
def test_a_nudge_moves_the_last_places_of_floats_only(a: np.ndarray, seed: int) -> None:
    inputs = VerificationInputs(
        [Frame(0, True, {"x": a, "n": np.arange(3)})], "recorded"
    )
    (frame,) = inputs.nudged(seed).frames
    moved = np.abs(frame.arrays["x"].astype(np.float64) - a)
    assert frame.arrays["x"].dtype == a.dtype
    assert np.all(moved <= 8 * np.abs(np.spacing(a)).astype(np.float64))
    assert np.all(moved > 0)
    assert np.array_equal(frame.arrays["n"], np.arange(3))


def test_outputs_do_not_keep_the_memory_of_their_session(driver: ir.Model) -> None:
    frame = Frame(0, True, {"camera": np.ones((1, 4), np.float32)})

    (outputs,) = VerificationInputs([frame], "recorded").run(driver)

    assert all(value.flags.owndata for value in outputs.values())


def test_the_search_for_a_guilty_pass_ends_and_says_what_was_drawn(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = (passes.scales(1.01), passes.ROUNDS)
    drawn = r"^scales promises .*; inputs were drawn \(seed \d+\): .* --frames FRAMES$"
    with pytest.raises(VerificationError, match=drawn):
        checks(LINEAR, context, *chosen)
    monkeypatch.setattr(pass_manager, "SEARCH_S", 0.0)
    with pytest.raises(VerificationError, match=r"normalize or scales or rounds prom"):
        checks(LINEAR, context, *chosen)
