"""Plans against what was really driven."""

import json
import math

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.fidelity.compare import common_adapter, compare
from me2e_compress.fidelity.open_loop import (
    NO_FUTURE,
    OpenLoop,
    OpenLoopTally,
    ego_boxes,
)
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.recorded_future import Box, RecordedFuture
from me2e_compress.runtime.session import Session

PLANNER = """
<ir_version: 9, opset_import: ["" : 17]>
planner (float[1,%d,2] x) => (float[1,%d,2] plan)
<float factor = {%s}> {
    plan = Mul(x, factor)
}
"""
MODES = """
<ir_version: 9, opset_import: ["" : 17]>
planner (float[1,3,6,2] x) => (float[1,3,6,2] modes) {
    modes = Identity(x)
}
"""
AHEAD = tuple((0.0, 2.0 * step) for step in range(1, 7))
"""4 m/s straight on, as nuScenes' lidar sees it: y is forward."""


def planner(factor: float, waypoints: int = 6, **adapter: object) -> Session:
    model = ir.from_onnx_text(PLANNER % (waypoints, waypoints, factor))
    if adapter:
        model.metadata_props["me2e.plan"] = json.dumps(adapter)
    return Session(model, threads=1)


def future(
    *others: Box, command: int = 2, known: bool = True, lost: int = 0
) -> RecordedFuture:
    return RecordedFuture(
        waypoints=AHEAD[: 6 - lost] + (None,) * lost,
        forward=math.pi / 2,
        ego=(4.0, 2.0),
        centre=(0.0, 0.5),
        agents=(others,) * 6 if known else None,
        command=command,
    )


def frame(
    index: int, what: RecordedFuture | None, starts: bool = False, waypoints: int = 6
) -> Frame:
    plan = np.array([AHEAD[:waypoints]], np.float32)
    return Frame(index, index == 0 or starts, {"x": plan}, future=what)


def judged(a: Session, b: Session, *frames: Frame) -> OpenLoop | str:
    adapter, reason = common_adapter(a, b)
    assert adapter is not None, reason
    tally = OpenLoopTally(adapter)
    compare(a, b, frames, tally.add)
    return OpenLoop.of(tally)


def found(candidate: Session, *frames: Frame, reference: float = 1.0) -> OpenLoop:
    result = judged(planner(reference), candidate, *frames)
    assert isinstance(result, OpenLoop)
    return result


def numbers(result: OpenLoop, measure: str, convention: str) -> list[float]:
    return [
        each.candidate
        for each in result.qualities
        if (each.measure, each.convention) == (measure, convention)
    ]


def test_l2_by_both_conventions() -> None:
    """Half as fast: 1 m too short after half a second, 2 m after one, ..."""
    result = found(planner(0.5), frame(0, future()))

    assert numbers(result, "l2", "at") == pytest.approx([2, 4, 6])
    assert numbers(result, "l2", "up-to") == pytest.approx([1.5, 2.5, 3.5])


def test_the_difference_is_paired() -> None:
    result = found(planner(0.5), frame(0, future()), reference=0.75)

    first = result.qualities[0]
    assert (first.reference, first.candidate) == pytest.approx((1.0, 2.0))
    assert first.difference == pytest.approx(1.0)
    assert first.low is None  # one frame


def test_scenes_are_drawn_anew() -> None:
    frames = [frame(i, future(), starts=i % 2 == 0) for i in range(6)]
    frames[3].arrays["x"] = np.array([AHEAD], np.float32) + 1

    result = found(planner(0.5), *frames)

    quality = result.qualities[0]
    assert (result.frames, result.scenes) == (6, 3)
    assert quality.low is not None
    assert quality.anew_low is not None
    assert quality.low <= quality.difference <= (quality.high or 0)
    assert quality.anew_low <= quality.difference <= (quality.anew_high or 0)


def test_a_plan_that_runs_into_a_box_collides() -> None:
    """A car 8 m ahead of the ego that stays; 1.5 times 12 m is 18 m: through it."""
    parked = (3.0, 11.0, 0.0, 4.0, 2.0)  # beside the recorded way, across
    result = found(planner(1.0), frame(0, future(parked)))
    assert numbers(result, "collision", "at") == [0, 0, 0]

    ahead = (0.0, 17.5, math.pi / 2, 4.0, 2.0)
    result = found(planner(1.5), frame(0, future(ahead)))
    # front at 0.5 + 2 ahead of the waypoint; touches from 13 m to 21.5 m
    assert numbers(result, "collision", "at") == [0, 0, 100]
    assert numbers(result, "collision", "up-to") == pytest.approx([0, 0, 100 / 3])


def test_nobody_is_blamed_where_the_recorded_drive_touches() -> None:
    here = (0.0, 12.0, 0.0, 4.0, 2.0)
    result = found(planner(1.0), frame(0, future(here)))

    assert numbers(result, "collision", "at") == [0, 0, 0]


@pytest.mark.parametrize(
    ("other", "touches"),
    [
        ((2.0, 12.5, 0.0, 1.9, 1.9), False),  # 1 m to its side: edge at 1.05
        ((1.9, 12.5, 0.0, 1.9, 1.9), True),
        ((2.2, 12.5, math.pi / 4, 1.9, 1.9), True),  # its corner reaches 1.34 m
        (
            (2.2, 15.7, math.pi / 4, 1.9, 1.9),
            False,
        ),  # parted slantwise
    ],
)
def test_boxes_are_oriented(other: Box, touches: bool) -> None:
    """The recorded ego stands still; the plan goes to 12 m."""
    still = future(other).model_copy(update={"waypoints": ((0.0, 0.0),) * 6})
    result = found(planner(1.0), frame(0, still))

    assert numbers(result, "collision", "at")[-1] == (100 if touches else 0)


def test_the_ego_looks_where_it_goes() -> None:
    path = np.array([[0, 0.1], [0, 2], [1, 3], [1.05, 3.05], [1, 4], [1, 5]], float)

    boxes = ego_boxes(path, future())

    degrees = np.degrees(boxes[:, 2])
    assert degrees == pytest.approx([90, 90, 45, 45, 90, 90])
    assert boxes[1, :2] == pytest.approx([0, 2.5])
    assert boxes[2, :2] == pytest.approx([1 + 0.5**1.5, 3 + 0.5**1.5])


def test_others_that_are_not_known_leave_collisions_out() -> None:
    result = found(planner(1.0), frame(0, future(known=False)))

    assert {each.measure for each in result.qualities} == {"l2"}


def test_frames_without_three_seconds_are_left_out() -> None:
    frames = [frame(0, future()), frame(1, future(lost=1)), frame(2, None)]

    result = found(planner(1.0), *frames)

    assert (result.frames, result.left_out) == (1, 2)


def test_a_short_plan_is_not_judged_beyond_its_end() -> None:
    """Four waypoints are 2 s."""
    session = planner(1.0, 4, output="plan", step_s=0.5)
    result = judged(session, session, frame(0, future(), waypoints=4))

    assert isinstance(result, OpenLoop)
    assert {each.horizon_s for each in result.qualities} == {1, 2}


def test_the_recorded_command_picks_the_mode() -> None:
    model = ir.from_onnx_text(MODES)
    adapter = {"output": "modes", "default_mode": 0}
    model.metadata_props["me2e.plan"] = json.dumps(adapter)
    x = np.full((1, 3, 6, 2), 9, np.float32)
    x[0, 2] = AHEAD
    session = Session(model, threads=1)

    result = judged(session, session, Frame(0, True, {"x": x}, future=future()))

    assert isinstance(result, OpenLoop)
    assert numbers(result, "l2", "at") == pytest.approx([0, 0, 0])


def test_a_command_without_a_mode_is_a_reason() -> None:
    model = ir.from_onnx_text(MODES)
    model.metadata_props["me2e.plan"] = '{"output": "modes", "default_mode": 0}'
    session = Session(model, threads=1)
    x = np.zeros((1, 3, 6, 2), np.float32)
    shown = Frame(0, True, {"x": x}, future=future(command=5))

    assert judged(session, session, shown) == "mode 5 of modes: it has 3 modes"


def test_no_ground_truth_is_not_measured() -> None:
    assert judged(planner(1.0), planner(1.0), frame(0, None)) == NO_FUTURE


def test_a_table_says_what_each_number_is() -> None:
    shown = found(planner(0.5), frame(0, future())).table()

    first = [str(cell.text) for cell in shown.rows[0]]
    assert first == ["L2 at 1 s, m", "0.00", "2.00", "+2.00", "-", "-"]
    assert len(shown.rows) == 12
    assert "1 frame of 1 scene whose" in shown.note
