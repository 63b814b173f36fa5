"""What a proof by running both graphs covers, and what it says where it covers less."""

import onnx_ir as ir
import pytest

from me2e_compress.errors import VerificationError
from me2e_compress.manager import PassManager, Verification
from me2e_compress.passes.base import Context, Pass
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
    assert check.fed == "synthetic, n=2 and n=3"
    assert set(check.errors) == {"y", "t"}


def test_a_wrong_pass_is_found_out_behind_an_open_dimension(context: Context) -> None:
    with pytest.raises(VerificationError, match=r"scales promises .* changed y by"):
        checks(MIXED, context, passes.scales(1.01))


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


def test_a_graph_that_runs_at_no_size_is_not_proven(context: Context) -> None:
    text = """m (float[n,4] x) => (float[7,997] y) <int64[2] odd = {7, 997}> {
        ["/backbone/Reshape"] y = Reshape(x, odd)
    }"""
    (check,) = checks(text, context, passes.IDLE)
    assert "runs at none of the sizes that were tried for n (" in (check.unproven or "")
    assert "--set-dim" in (check.unproven or "")


def test_inputs_that_are_no_numbers_are_not_proven(context: Context) -> None:
    text = """m (string[2] x) => (string[2] y) {
        ["/backbone/Identity"] y = Identity(x)
    }"""
    (check,) = checks(text, context, passes.IDLE)
    assert check.unproven == "input x is STRING: seeded inputs are numbers"


def test_what_is_checked_on_no_frame_is_not_proven(context: Context) -> None:
    (check,) = checks(MIXED, context, passes.ROUNDS, frames=0)
    assert check.passes == ("import-normalize", "rounds")
    assert check.unproven == "no frame was asked for (--verify-frames 0)"


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


def test_where_every_output_is_drawn_nothing_is_proven(context: Context) -> None:
    text = """m (float[64] x) => (float[64] noise) {
        ["/backbone/Noise"] noise = RandomNormalLike(x)
    }"""
    (check,) = checks(text, context, passes.IDLE)
    assert check.unproven == "noise: another at every run"


REDUCED = """m (float[1,1,16] x, custom) => (float[1,1,1] y) <int64[1] axes = {2}> {
    ["/backbone/Sum"] y = ReduceSum<keepdims = 1>(x, axes)
}""".replace(", custom", "")


@pytest.mark.parametrize(
    ("axis", "reason"),
    [(3, "axis must be in"), (0, r"y is \[1,1,16\], not \[1,1,1\]")],
)
def test_a_wrong_axis_is_caught_without_a_run(
    axis: int, reason: str, context: Context
) -> None:
    with pytest.raises(VerificationError, match=rf"leaves left node .*Sum.*{reason}"):
        checks(REDUCED, context, passes.leaves(axis), frames=0)


NORM = """m (float[4,8] x) => (float[4,8] y)
    <float[8] g = {1, 2, 3, 4, 5, 6, 7, 8}, float[8] b = {1, 2, 3, 4, 5, 6, 7, 8},
     float one = {1}, float two = {2}, float[1] e = {0.1}> {
    ["/backbone/Mean"] m = ReduceMean<axes = [-1]>(x)
    ["/backbone/Sub"] d = Sub(x, m)
    ["/backbone/Pow"] s = Pow(d, two)
    ["/backbone/Var"] v = ReduceMean<axes = [-1]>(s)
    ["/backbone/Eps"] w = Add(e, v)
    ["/backbone/Sqrt"] r = Sqrt(w)
    ["/backbone/Div"] i = Div(one, r)
    ["/backbone/Mul"] n = Mul(d, i)
    ["/backbone/Gain"] k = Mul(g, n)
    ["/backbone/Bias"] y = Add(k, b)
}"""
"""onnxruntime (1.31) fuses this to a LayerNormalization of another epsilon."""


def test_what_onnxruntime_itself_changes_is_no_fault_of_a_pass(
    context: Context,
) -> None:
    (check,) = checks(NORM, context, passes.SWAPS_TERMS)
    assert check.errors["y"] < 1e-6
    (remark,) = check.remarks
    assert "another y of the graph before the passes at its level basic" in remark
    assert "from node /backbone/Bias (Add)" in remark


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
    with pytest.raises(VerificationError, match=r"^scales promises .* changed y by"):
        checks(LINEAR, context, passes.scales(1 + share))


def test_the_place_is_named_where_a_pass_breaks_its_promise(context: Context) -> None:
    words = r"inputs\); first difference: module backbone, y of /backbone/Mul \(Mul\)"
    with pytest.raises(VerificationError, match=words):
        checks(LINEAR, context, passes.scales(1.05))


HARD = """hard (float[1,8] x) => (float[1,8] choice, float[1,8] steady)
<float[8] w = {1.5, 2.1, 3.7, 4.3, 5.9, 6.1, 7.7, 8.3}, float k = {1e8}> {
    ["/backbone/Mul"] a = Mul(x, w)
    ["/plan_head/Mul"] b = Mul(a, k)
    ["/plan_head/Sin"] c = Sin(b)
    ["/plan_head/Sign"] choice = Sign(c)
    ["/occ_head/Tanh"] steady = Tanh(a)
}"""
"""``choice`` hangs on the last places of ``x``."""


def test_what_rounding_alone_decides_is_not_held_against_a_pass(
    context: Context,
) -> None:
    (check,) = checks(HARD, context, passes.ROUNDS)
    assert check.unsteady == ("choice",)
    assert check.errors["choice"] > 1.0
    assert 0.0 < check.errors["steady"] < check.tolerances["steady"]


def test_what_is_steady_is_judged_beside_it(context: Context) -> None:
    suspects = (passes.ROUNDS, passes.TurnsTanhIntoSigmoid())
    words = r"^turns-tanh-into-sigmoid promises .* changed steady by"
    with pytest.raises(VerificationError, match=words):
        checks(HARD, context, *suspects)
