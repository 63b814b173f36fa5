import math

import numpy as np
import pytest

from me2e_compress.fidelity.compare import (
    Displacement,
    Fidelity,
    OutputFidelity,
    Reference,
)
from me2e_compress.fidelity.floor import Floor, Rounding, choice_between
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session
from tests.nets import parsed

CHOOSER = """
chooser (float[1,4] img)
    => (float[1,4] steady, float[1,1] chosen, int64[1,1] label, float[1,1] coarse)
<int64[1] one = {1}, float[4] boxes = {1.0, -5.0, 9.0, -40.0},
 float[4,1] apart = {1000.0, -1000.0, 0.0, 0.0}> {
    steady = Identity(img)
    coarse = MatMul(img, apart)
    ["/head/TopK"] best, label = TopK<axis=-1>(img, one)
    chosen = Gather(boxes, label)
}
"""


def found(plan_m: float | None = None, **sqnr_db: float) -> Fidelity:
    """A measurement; the output ``labels`` is discrete."""
    outputs = [OutputFidelity(k, v, 0.0, k == "labels") for k, v in sqnr_db.items()]
    moved = None if plan_m is None else Displacement(plan_m, 2 * plan_m)
    name = "" if plan_m is None else "plan"
    return Fidelity(tuple(outputs), (), moved, "", 1, name)


def test_what_is_below_the_floor_is_listed_the_worst_first() -> None:
    below = Floor(20.0).shortfalls(found(bev=0.0, good=20.0, boxes=14.0))

    assert [str(each) for each in below] == ["bev 0.0 dB", "boxes 14.0 dB"]
    assert below[0].excess == pytest.approx(10.0)


def test_the_plan_is_judged_in_metres_where_they_are_known() -> None:
    assert not Floor().shortfalls(found(plan_m=0.4, plan=3.0))
    assert str(Floor().shortfalls(found(plan_m=0.6, plan=3.0))[0]) == "plan 0.60 m"
    assert str(Floor().shortfalls(found(plan=3.0))[0]) == "plan 3.0 dB"


def test_labels_and_unsteady_outputs_are_not_judged() -> None:
    assert not Floor().shortfalls(found(labels=-3.0, boxes=-3.0), {"boxes": 1.0})


def test_what_ought_to_be_zero_is_worse_than_anything_finite() -> None:
    below = Floor().shortfalls(found(bev=-60.0, empty=-math.inf))

    assert below[0].output == "empty"
    assert math.isfinite(below[0].excess)


def test_an_output_that_chooses_is_told_by_rounding_the_input() -> None:
    """4.001 and 4.0 are one step of int8: the first of the two is chosen then.

    Their difference is lost as well, but nothing chooses there.
    """
    values = np.array([[4.0, 4.001, -127.0, 0.0]], np.float32)
    frames = [Frame(0, True, {"img": values})]
    model = parsed(CHOOSER)
    reference = Reference.of(Session(model), frames)

    found = Rounding.of(reference, model, Floor())

    assert found.input == "img"
    assert list(found.values) == ["chosen", "coarse"]
    assert found.values["chosen"] < 0
    assert found.choices == {"chosen": "/head/TopK (TopK)"}
    assert found.among(["coarse"]) == Rounding(
        "img", {"coarse": found.values["coarse"]}, {}
    )


CHOICES = """
<ir_version: 9, opset_import: ["" : 18, "own" : 1]>
choices (float[1,4] x, float[1,4] z) => (float[1,4] plain, float[1,4] masked,
    float[1,4] cast, float[1,4] inside, float[1,4] called, float[1,4] beside)
<float[1] zero = {0.0}, bool yes = {1}> {
    ["/Exp"] plain = Exp(x)
    ["/Greater"] positive = Greater(x, zero)
    ["/Where"] masked = Where(positive, x, zero)
    ["/Cast"] whole = Cast<to=7>(x)
    ["/Back"] cast = Cast<to=1>(whole)
    ["/If"] inside = If(yes)<
        then_branch = then_graph () => (float[1,4] a) { a = Round(x) },
        else_branch = else_graph () => (float[1,4] b) { b = Identity(x) }
    >
    ["/Call"] called = own.steps(x)
    ["/Less"] small = Less(z, zero)
    ["/Mask"] beside = Where(small, x, zero)
}
<domain: "own", opset_import: ["" : 18]>
steps (x) => (y) { y = Floor(x) }
"""


@pytest.mark.parametrize(
    ("output", "choice"),
    [
        ("plain", ""),
        ("masked", "/Greater (Greater)"),
        ("cast", "/Cast (Cast)"),
        ("inside", "/If (If)"),
        ("called", "/Call (steps)"),
        ("beside", ""),
    ],
)
def test_what_chooses_between_an_input_and_an_output_is_named(
    output: str, choice: str
) -> None:
    """A mask that another input makes is none of it."""
    model = parsed(CHOICES)

    assert choice_between(model, "x", output) == choice
