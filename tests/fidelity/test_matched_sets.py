"""Agents in another order are the same agents."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.recording import write_recording
from me2e_compress.errors import GraphError
from me2e_compress.fidelity.compare import SetFidelity, SetOutputs, SetTally, compare
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.compare import compare as compare_files
from me2e_compress.workflows.options import CompareOptions
from tests.nets import parsed, save_text

Frames = dict[str, np.ndarray]

BOXES = np.array([[10.0, 0, 4, 2], [20, 3, 4, 2], [5, -4, 4, 2], [90, 9, 4, 2]])
SCORES = np.array([0.9, 0.8, 0.7, 0.1])
OUTPUTS = SetOutputs(boxes="boxes", scores="scores")

SWAPPED = """
tracker (float[1,2,3] x, float[1,2] s) => (float[1,2,3] boxes, float[1,2] scores)
<int64[2] order = {%s}> {
    boxes = Gather <axis = 1> (x, order)
    scores = Gather <axis = 1> (s, order)
}
"""

SCORED = """
chooser (float[1,2,6,2] x, float[1,2] s) => (float[1,2,6,2] plans, float[1,2] votes)
<float bias = {%s}> {
    plans = Identity(x)
    votes = Pow(s, bias)
}
"""


def outputs(boxes: np.ndarray, scores: np.ndarray) -> Frames:
    return {"boxes": boxes[None], "scores": scores[None]}


def matched(left: Frames, right: Frames) -> SetFidelity:
    tally = SetTally(OUTPUTS)
    tally.add(left, right, Frame(0, True, {}))
    return tally.result()


@pytest.mark.parametrize("order", [[3, 2, 1, 0], [1, 0, 2, 3], [2, 3, 0, 1]])
def test_the_order_does_not_matter(order: list[int]) -> None:
    found = matched(outputs(BOXES, SCORES), outputs(BOXES[order], SCORES[order]))

    assert (found.agents, found.matched) == (3, 3)
    assert found.sqnr_db == {"boxes": math.inf, "scores": math.inf}


def test_an_agent_that_moved_a_metre() -> None:
    moved = BOXES.copy()
    moved[0, 1] += 1.0

    found = matched(outputs(BOXES, SCORES), outputs(moved[::-1], SCORES[::-1]))

    signal = float((BOXES[:3] ** 2).sum())
    assert found.sqnr_db["boxes"] == pytest.approx(10 * math.log10(signal))


def test_an_agent_that_is_lost_has_no_match() -> None:
    other = BOXES.copy()
    other[0, 0] = 40.0

    found = matched(outputs(BOXES, SCORES), outputs(other, SCORES))

    assert (found.agents, found.matched) == (3, 2)


def test_nobody_is_sure_of_anybody() -> None:
    found = matched(outputs(BOXES, SCORES / 10), outputs(BOXES, SCORES / 10))

    assert found == SetFidelity(0, 0, {})


def test_the_outputs_are_named_in_the_metadata() -> None:
    named = json.dumps({"boxes": "tracks", "scores": "sure"})
    shapes = {"tracks": (1, 9, 7), "sure": (1, 9)}

    found = SetOutputs.of({"me2e.sets": named}, shapes)

    assert found == SetOutputs(boxes="tracks", scores="sure")
    assert SetOutputs.of({}, {"boxes": (1, 9, 7), "scores": (1, 9)}) is None


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ({"box": "boxes"}, r"me2e\.sets names no outputs"),
        ({"boxes": "boxes", "scores": "votes"}, "votes has no row for every agent"),
        ({"boxes": "boxes", "scores": "few"}, "few has no row for every agent"),
    ],
)
def test_metadata_that_is_no_set_is_named(named: dict[str, str], message: str) -> None:
    shapes = {"boxes": (1, 4, 4), "few": (1, 3)}
    with pytest.raises(GraphError, match=message):
        SetOutputs.of({"me2e.sets": json.dumps(named)}, shapes)


@pytest.mark.parametrize("has_scores", [True, False])
def test_compare_matches_what_both_graphs_have(
    tmp_path: Path, has_scores: bool
) -> None:
    sets = json.dumps({"boxes": "boxes", "scores": "scores"})
    save_text(tmp_path / "one.onnx", SWAPPED % "0, 1", **{"me2e.sets": sets})
    text = SWAPPED if has_scores else SWAPPED.replace("scores", "votes")
    save_text(tmp_path / "other.onnx", text % "1, 0")
    arrays: dict[str, Array] = {
        "x": np.array([[[1, 2, 3], [9, 8, 7]]], np.float32),
        "s": np.array([[0.9, 0.8]], np.float32),
    }
    write_recording(tmp_path / "frames", lambda _: [Frame(0, True, arrays)], {})

    one, other, frames = (tmp_path / n for n in ("one.onnx", "other.onnx", "frames"))
    found = compare_files(one, other, frames, CompareOptions(alive=0.0))

    assert found.fidelity.outputs[0].sqnr_db < 6.0
    if has_scores:
        assert found.agents is not None
        assert found.agents.sqnr_db["boxes"] == math.inf
    else:
        assert found.agents is None


def chooser(bias: float) -> Session:
    model = parsed(SCORED % bias)
    model.metadata_props["me2e.plan"] = json.dumps(
        {"output": "plans", "scores": "votes"}
    )
    return Session(model)


def votes(first: float, second: float) -> Frame:
    x = np.stack([np.zeros((6, 2)), np.ones((6, 2))])[None]
    scores = np.array([[first, second]], np.float32)
    return Frame(0, starts_scene=True, arrays={"x": x.astype(np.float32), "s": scores})


def test_a_scored_plan_is_compared_by_the_candidate_that_is_chosen() -> None:
    # a power of -1 turns the order of the votes round, but for equal ones
    frames = [votes(0.5, 0.9), votes(0.9, 0.5), votes(0.7, 0.7), votes(0.2, 0.4)]

    found = compare(chooser(1.0), chooser(-1.0), frames)

    assert found.same_choice == 0.25
    assert found.plan is not None
    assert found.plan.max_m == pytest.approx(math.sqrt(2.0))


def test_scores_that_are_not_there_are_named() -> None:
    text = json.dumps({"output": "plan", "scores": "votes"})

    with pytest.raises(GraphError, match="names output votes; there is plan"):
        PlanAdapter.of({"me2e.plan": text}, ["plan"])
