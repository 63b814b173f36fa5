"""How one output is judged, on one part of an input at a time."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.fidelity.compare import compare
from me2e_compress.fidelity.liveness import (
    LivenessTally,
    Part,
    measure_liveness,
    parts_of,
)
from me2e_compress.fidelity.output_liveness import (
    Liveness,
    Movement,
    share_without_jumps,
)
from me2e_compress.fidelity.saturation import Cause
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session

TWO = """
<ir_version: 9, opset_import: ["" : 17]>
two (float[1,8] x, float[1,8] z) => (float[1,8] y)
<float scale = {%s}, int8 zero = {0}> {
    q = QuantizeLinear(x, scale, zero)
    d = DequantizeLinear(q, scale, zero)
    y = Add(d, z)
}
"""


def test_the_scale_that_makes_an_output_deaf_to_one_input_is_named() -> None:
    random = np.random.default_rng(0)
    frames = [
        Frame(at, not at, {name: random.random((1, 8), np.float32) for name in "xz"})
        for at in range(4)
    ]
    models = [ir.from_onnx_text(TWO % scale) for scale in ("0.01", "5e7")]
    models[1].graph[0].name = "/Quantize"
    a, b = map(Session, models)
    tally = LivenessTally(a, b)
    compare(a, b, frames, tally.add)

    (fault,) = tally.result(model=models[1]).faults

    assert fault == (
        "y is deaf: of the movement before it answers x (0.00%); /Quantize rounds all"
        " that it reads to zero: its scale is too large"
    )


PICTURE = """
<ir_version: 9, opset_import: ["" : 17]>
picture (float[1,8] x) => (float[1,8] y) <float low = {-9.0}, float high = {%s}> {
    y = Clip(x, low, high)
}
"""


@pytest.mark.parametrize(("high", "verdict"), [("9.0", "alive"), ("0.2", "saturated")])
def test_an_output_at_its_largest_value_is_saturated(high: str, verdict: str) -> None:
    random = np.random.default_rng(0)
    frames = [
        Frame(at, not at, {"x": random.uniform(0.1, 1, (1, 8)).astype("f")})
        for at in range(4)
    ]
    a, b = (Session(ir.from_onnx_text(PICTURE % most)) for most in ("9.0", high))

    (found,) = measure_liveness(a, b, frames).outputs

    assert found.verdict == verdict


@pytest.mark.parametrize(
    ("shape", "cameras"),
    [
        ((1, 6, 3, 16, 16), 6),
        ((6, 3, 16, 16), 6),
        ((1, 2, 16, 16, 3), 2),
        ((1, 4, 2, 3, 16, 16), 2),
        ((1, 3, 16, 16), 0),
        ((1, 6, 4, 4), 0),
        ((20, 3, 6, 2), 0),
        ((6, 8, 16, 16), 0),
        ((18,), 0),
    ],
)
def test_cameras_are_told_by_the_shape(shape: tuple[int, ...], cameras: int) -> None:
    expected = [Part("x", at) for at in range(cameras)] or [Part("x")]

    assert parts_of("x", np.zeros(shape)) == expected


OPEN = """
<ir_version: 9, opset_import: ["" : 17]>
picks (float[n] x, int64[1] at) => (float[1] y) { y = Gather(x, at) }
"""


def test_an_input_that_cannot_be_exchanged_alone_is_not_judged() -> None:
    """The third of two numbers: the graph fails, and the others are still judged."""
    frames = [
        Frame(
            size - 2,
            size == 2,
            {"x": np.arange(float(size)).astype("f"), "at": np.array([size - 1])},
        )
        for size in (2, 3)
    ]
    session = Session(ir.from_onnx_text(OPEN))

    found = measure_liveness(session, session, frames)

    assert "indices element out of data bounds" in found.unjudged["x"]
    assert found.outputs[0].answers == {"at": 1.0}


def test_what_is_not_judged_is_no_proof_that_all_is_alive() -> None:
    """Labels that rest in the second graph alone are whole numbers, and not judged."""
    rests = Movement()
    for at in range(2):
        now, before = ([np.array([each]), np.array([0])] for each in (at, at - 1))
        rests.add(now, before if at else None)
    judged = rests.judged("label", {}, 0.01, lambda: Cause(), ablated=False)
    assert (judged.verdict, judged.moves) == ("not judged", 0)

    said = list(Liveness((judged,), 0.01).lines())

    assert said == ["liveness not judged: label (whole numbers)"]


def test_a_slot_that_jumps_in_one_graph_alone_does_not_hide_the_others() -> None:
    draws = np.random.default_rng(3)
    before, move = draws.normal(size=20), 0.01 * draws.normal(size=20)
    jumped = before + move
    jumped[4] += 5.0

    alike = share_without_jumps((before, jumped), (before, before + 0.9 * move))
    deaf = share_without_jumps((before, jumped), (before, before))

    assert alike == pytest.approx(0.9)
    assert deaf == 0
