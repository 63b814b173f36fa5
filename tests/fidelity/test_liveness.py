"""Outputs that hardly move any more are named, and others are not."""

import dataclasses
import json

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.fidelity.compare import compare
from me2e_compress.fidelity.liveness import Liveness, LivenessTally, OutputTally
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session
from tests.support.nets import parsed

DRIVER = """
driver (float[1,2,3,16,16] img, float[1,4] can_bus, int64[1] command, float[1,2] prev)
    => (float[1,2] plan, float[1,2] prev_out, int64[1] label, float[1,2] still)
<float[1,2] seen = {SEEN}, float[1] turns = {TURNS}, float[1] history = {HISTORY},
 float[1] gain = {GAIN}, float[1] scale = {SCALE}, int8[1] zero = {0},
 float[1] high = {CEILING}, float[1,2] rest = {1.0, 2.0},
 float[3,2] table = {0.0, 1.0, 2.0, 3.0, -4.0, 5.0}> {
    ["/see"] means = ReduceMean<axes=[2,3,4], keepdims=0>(img)
    ["/see/Mul"] cameras = Mul(means, seen)
    ["/turn"] way = Gather(table, command)
    ["/turn/Mul"] turn = Mul(way, turns)
    ["/remember"] before = Mul(prev, history)
    ["/Add"] prev_out = Add(cameras, turn)
    ["/Sum"] sum = Add(prev_out, before)
    ["/Gain"] weighed = Mul(sum, gain)
    ["/Quantize"] q = QuantizeLinear(weighed, scale, zero)
    ["/Dequantize"] back = DequantizeLinear(q, scale, zero)
    ["/Min"] plan = Min(back, high)
    ["/Label"] label = Identity(command)
    ["/Rest"] still = Identity(rest)
}
"""
HEALTHY = {
    "SEEN": "1.0, 1.0", "TURNS": "1.0", "HISTORY": "0.5", "GAIN": "1.0",
    "SCALE": "0.1", "CEILING": "1000000.0",
}  # fmt: skip
FED = {"prev": "prev_out"}
"""The state, as the metadata pair it."""


def driver(*, fed: bool = True, **changed: str) -> ir.Model:
    """A small driver; what is changed are its constants."""
    text = DRIVER
    for name, value in (HEALTHY | changed).items():
        text = text.replace(f"{{{name}}}", f"{{{value}}}")
    model = parsed(text)
    model.metadata_props["me2e.recurrent"] = json.dumps(FED if fed else {"prev": None})
    return model


def drive(count: int = 4, scenes: tuple[int, ...] = (0,)) -> list[Frame]:
    """Frames of which all but the CAN bus changes."""
    random = np.random.default_rng(0)
    return [
        Frame(
            index,
            index in scenes,
            {
                "img": random.random((1, 2, 3, 16, 16), np.float32) * (index + 1),
                "can_bus": np.ones((1, 4), np.float32),
                "command": np.array([index % 3]),
            },
        )
        for index in range(count)
    ]


def measured(model: ir.Model, frames: list[Frame] | None = None) -> Liveness:
    a, b = Session(driver()), Session(model)
    tally = LivenessTally(a, b)
    compare(a, b, drive() if frames is None else frames, [tally.add])
    return tally.result()


@pytest.mark.parametrize("scenes", [(0,), (0, 2), (0, 1, 2, 3)])
def test_a_graph_in_int8_that_works_is_alive(scenes: tuple[int, ...]) -> None:
    found = measured(driver(), drive(scenes=scenes))

    assert found.faults == ()
    assert {each.output: each.verdict for each in found.outputs} == {
        "plan": "alive", "prev_out": "alive", "label": "not judged",
        "still": "not judged",
    }  # fmt: skip
    *_, said = found.lines()
    assert "label (whole numbers), still (it rests in the first graph too)" in said


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"SCALE": "5e6"}, "constant: it moves 0.00% as far as before"),
        ({"GAIN": "0.005", "SCALE": "0.0005"}, "frozen: it moves 0.50% as far"),
        ({"CEILING": "-1000.0"}, "constant: it moves 0.00% as far as before"),
    ],
)
def test_what_is_dead_is_named(changed: dict[str, str], said: str) -> None:
    found = measured(driver(fed=True, **changed))

    assert found.faults[0].startswith(f"plan is {said}")


def tally(*pairs: tuple[Array, Array]) -> OutputTally:
    made = OutputTally("y")
    for pair in pairs:
        made.add(*pair)
    return made


def test_movement_is_the_standard_deviation_over_frames() -> None:
    draws = np.random.default_rng(0).normal(3.0, 1.0, (5, 2, 4))
    moving = tally(*((each, 0.25 * each + 7.0) for each in draws))
    # rounding is no movement
    resting = tally(*((np.full(4, 1.0 + at * 1e-5), np.ones(4)) for at in range(3)))
    growing = tally(*((each, each) for each in (np.ones(2), np.ones(3))))

    assert moving.result(0.2).verdict == "weak"
    assert moving.result(0.2).moves == pytest.approx(0.25)
    assert moving.result(0.3).verdict == "frozen"
    (line,) = Liveness((moving.result(0.2),), 0.01).lines()
    assert line == "none dead, but weak (least of all y: 25%)"
    assert resting.result(0.01).reason == "it rests in the first graph too"
    assert str(growing.result(0.01)) == "y is not judged: its shape changes"


def test_a_state_that_is_not_fed_is_named() -> None:
    """The recorded state is fed instead; it is that of no frame before."""
    frames = [
        dataclasses.replace(each, arrays=each.arrays | {"prev": np.ones((1, 2), "f")})
        for each in drive()
    ]

    found = measured(driver(fed=False), frames)

    assert found.faults == ("prev is not fed back any more",)


def test_one_frame_is_not_measured_and_that_is_said() -> None:
    found = measured(driver(SCALE="5e6"), drive(1))

    assert found.faults == ()
    assert list(found.lines()) == [
        "liveness: not measured (one frame alone: nothing moves)"
    ]
