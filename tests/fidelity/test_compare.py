import json
import math
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import EvaluationError, GraphError
from me2e_compress.calibration.recording import write_recording
from me2e_compress.commands.compare import compare as compare_files
from me2e_compress.commands.options import CompareOptions
from me2e_compress.fidelity.compare import (
    Displacement,
    Fidelity,
    OutputFidelity,
    SetFidelity,
    SetOutputs,
    SetTally,
    Tally,
    channel_axes,
    compare,
)
from me2e_compress.fidelity.floor import Floor
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.runtime.session import Session
from tests.support.command import write_frames
from tests.support.nets import parsed, save_text

SCALED = """
scaled (float[1,2] x, float[1,2] s) => (float[1,2] y, float[1,2] s_out)
<float gain = {%s}> {
    sum = Add(x, s)
    s_out = Mul(sum, gain)
    y = Identity(s_out)
}
"""

PLANNER = """
planner (float[1,3,6,2] x, int64[1] command) => (float[1,3,6,2] modes, int64[1] c)
<float step = {%s}> {
    modes = Add(x, step)
    c = Identity(command)
}
"""


def scaled(gain: float) -> Session:
    return Session(parsed(SCALED % gain))


def ones(index: int, starts: bool = False) -> Frame:
    return Frame(index, starts, {"x": np.ones((1, 2), np.float32)})


def planner(step: float, **adapter: object) -> Session:
    model = parsed(PLANNER % step)
    if adapter:
        model.metadata_props["me2e.plan"] = json.dumps(adapter)
    return Session(model)


def modes(command: int = 0) -> Frame:
    arrays = {"x": np.zeros((1, 3, 6, 2), np.float32), "command": np.array([command])}
    return Frame(0, True, arrays)


def test_equal_models_are_infinitely_faithful() -> None:
    found = compare(scaled(0.5), scaled(0.5), [ones(0, True), ones(1)])

    assert [(each.name, each.sqnr_db, each.error) for each in found.outputs] == [
        ("y", math.inf, 0.0),
        ("s_out", math.inf, 0.0),
    ]
    assert (found.frames, found.missing, found.plan) == (2, (), None)
    assert "does not say" in found.plan_reason


def test_signal_to_noise_pools_all_frames_each_model_with_its_own_state() -> None:
    found = compare(scaled(1.0), scaled(0.5), [ones(0, True), ones(1), ones(2, True)])

    # a: 1, 2, 1; b: 0.5, 0.75, 0.5
    noise, signal = 0.25 + 1.5625 + 0.25, 1 + 4 + 1
    assert found.outputs[0].sqnr_db == pytest.approx(10 * math.log10(signal / noise))
    assert found.outputs[0].error == pytest.approx(1.25 / 2)
    # against the mean signal of 2, the noises of frames are 0.25, 1.5625 and 0.25
    assert found.outputs[0].by_frame == "1.1 to 9.0"
    # frames that ranges were measured on widen that alone
    seen = compare(scaled(1.0), scaled(0.75), [ones(0, True), ones(1, True)])
    wide, alone = found.widen(seen), compare(scaled(1.0), scaled(0.5), [ones(0, True)])
    assert wide.outputs[0].by_frame == "1.1 to 12.0"
    assert (wide.frames, wide.seen) == (3, 2)
    assert alone.outputs[0].by_frame == ""


@pytest.mark.parametrize(
    ("adapter", "mean", "largest"),
    [
        ({}, math.sqrt(2), math.sqrt(2)),
        ({"deltas": True}, 3.5 * math.sqrt(2), 6 * math.sqrt(2)),
    ],
)
def test_the_plan_moves_in_metres(
    adapter: dict[str, object], mean: float, largest: float
) -> None:
    adapter = {"output": "modes", "default_mode": 0, **adapter}
    found = compare(planner(0, **adapter), planner(1, **adapter), [modes()])

    assert found.plan is not None
    assert found.plan.mean_m == pytest.approx(mean)
    assert found.plan.max_m == pytest.approx(largest)
    assert found.plan_reason == ""


def test_modes_that_nothing_picks_from_name_the_file(tmp_path: Path) -> None:
    model = parsed(PLANNER % 0)
    model.metadata_props["me2e.plan"] = json.dumps({"output": "modes"})
    graph.save(model, tmp_path / "vad.onnx")
    write_frames(tmp_path / "frames", **modes().arrays)

    with pytest.raises(GraphError, match=r"vad.onnx: modes has 3 modes and nothing"):
        compare_files(tmp_path / "vad.onnx", tmp_path / "vad.onnx", tmp_path / "frames")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not a plan"),
        ("{}", "is not a plan"),
        ('{"output": "y", "stride": 1}', "is not a plan"),
        ('{"output": "z"}', "names output z; there is y"),
        ('{"output": "y", "scores": "votes"}', "names output votes; there is y"),
    ],
)
def test_metadata_that_describes_no_plan_is_refused(text: str, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        PlanAdapter.of({"me2e.plan": text}, ["y"])


def test_an_output_called_plan_is_the_plan() -> None:
    assert PlanAdapter.of({}, ["bev", "plan"]) == PlanAdapter(output="plan")
    assert PlanAdapter.of({}, ["bev"]) is None


def of_one_output(a: object, b: object) -> OutputFidelity:
    tally = Tally("y")
    tally.add(np.asarray(a, np.float32), np.asarray(b, np.float32), 0)
    return tally.result()


def test_what_is_no_number_in_both_is_left_out() -> None:
    nan, inf = math.nan, math.inf
    found = of_one_output([[nan, inf, 3, 4]], [[nan, inf, 3, 4.5]])
    assert found.sqnr_db == pytest.approx(10 * math.log10(25 / 0.25))
    assert found.stray == 0


@pytest.mark.parametrize("other", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("first", [True, False])
def test_what_is_no_number_in_one_is_noise_without_end(
    other: float, first: bool
) -> None:
    pair = [[1, other, 3, 4]], [[1, 2, 3, 4]]
    found = of_one_output(*(pair if first else pair[::-1]))
    assert (found.sqnr_db, found.error, found.stray) == (-math.inf, math.inf, 0.25)
    assert of_one_output([[-math.inf]], [[math.inf]]).stray == 1
    (below,) = Floor().shortfalls(Fidelity((found,), (), None, "", 1))
    assert str(below) == "y -inf dB"


def test_small_channels_beside_large_ones_are_judged_apart() -> None:
    random = np.random.default_rng(0)
    boxes, scores = random.uniform(-600, 600, (1, 50, 4)), random.random((1, 50, 6))
    truth = np.concatenate([boxes, scores], 2)
    noise = random.normal(size=truth.shape) * 0.5
    found = of_one_output(truth, truth + noise)
    turned = of_one_output(*(np.swapaxes(a, 1, 2) for a in (truth, truth + noise)))

    assert found.sqnr_db > 50
    assert (found.small, turned.small) == ("[:, :, 4:10]", "[:, 4:10]")
    assert found.small_db == pytest.approx(turned.small_db)
    (below,) = Floor().shortfalls(Fidelity((found,), (), None, "", 1))
    assert str(below) == f"y[:, :, 4:10] {found.small_db:.1f} dB"
    assert of_one_output(boxes, boxes + 0.5).small == ""


@pytest.mark.parametrize("values", [(600, 600, 1), (600, 90, 11, 1), (50, 6, 1)])
@pytest.mark.parametrize("layers", [(2, 1), (1, 6), (1, 3, 5, 5), ()])
def test_what_is_30_times_smaller_is_apart_wherever_its_channels_stand(
    values: tuple[float, ...], layers: tuple[int, ...]
) -> None:
    sizes = np.array([*values, 1.0])
    truth = np.random.default_rng(0).uniform(-1, 1, (*layers, 30, len(sizes))) * sizes
    small = of_one_output(truth, truth + 0.1).small

    apart = np.flatnonzero(sizes * 30 < sizes[0]).tolist()
    ranges = {1: f"{apart[0]}", 2: f"{apart[0]}:{len(sizes)}"}[min(2, len(apart))]
    assert small == f"[{':, ' * (len(layers) + 1)}{ranges}]"


@pytest.mark.parametrize(
    ("axes", "shapes"),
    [
        ((1,), [(9, 2), (1, 8, 50), (1, 8, 40, 30)]),
        ((2,), [(1, 50, 8), (1, 8, 8)]),
        ((3,), [(6, 1, 50, 8), (6, 50, 1, 8)]),
        ((1, 3), [(1, 6, 900, 10), (1, 20, 20, 85)]),
        ((), [(8,), (9, 1), (9, 129), (2, 300, 64, 64)]),
    ],
)
def test_channels_are_the_last_axis_the_shorter_or_those_of_pictures(
    axes: tuple[int, ...], shapes: list[tuple[int, ...]]
) -> None:
    assert {channel_axes(shape) for shape in shapes} == {axes}


def test_models_with_nothing_in_common_and_no_frames_are_not_compared() -> None:
    with pytest.raises(EvaluationError, match=r"no tensor in common: y, .*modes"):
        compare(scaled(1.0), planner(0), [ones(0, True)])
    with pytest.raises(EvaluationError, match="no frames"):
        compare(scaled(1.0), scaled(1.0), [])


def test_a_sequence_is_not_compared() -> None:
    text = """
    g (float[1,2] x) => (seq(float[1,2]) s%s)
    { r = Relu(x) s = SequenceConstruct(r) }"""
    alone, beside = (parsed(text % more) for more in ("", ", float[1,2] r"))
    with pytest.raises(EvaluationError, match="no tensor in common: s and s"):
        compare(Session(alone), Session(alone), [ones(0, True)])
    found = compare(Session(beside), Session(beside), [ones(0, True)])
    assert [each.name for each in found.outputs] == ["r"]


def test_outputs_that_went_are_listed_and_a_lost_plan_has_a_reason() -> None:
    model = parsed(PLANNER % 0)
    model.graph.outputs.pop(0)
    adapter = {"output": "modes"}

    found = compare(planner(0, **adapter), Session(model), [modes()])

    assert found.missing == ("modes",)
    assert found.plan is None
    assert found.plan_reason == "the second model has no output modes"


def found(plan_m: float | None = None, **sqnr_db: float) -> Fidelity:
    """A measurement; the output ``labels`` is discrete."""
    outputs = [OutputFidelity(k, v, 0.0, k == "labels") for k, v in sqnr_db.items()]
    moved = None if plan_m is None else Displacement(plan_m, 2 * plan_m)
    name = "" if plan_m is None else "plan"
    return Fidelity(tuple(outputs), (), moved, "", 1, name)


@pytest.mark.parametrize(
    ("measured", "below"),
    [
        (found(bev=0.0, good=20.0, boxes=14.0), ["bev 0.0 dB", "boxes 14.0 dB"]),
        # the plan is judged in metres where they are known
        (found(plan_m=0.4, plan=3.0), []),
        (found(plan_m=0.6, plan=3.0), ["plan 0.60 m"]),
        (found(plan=3.0), ["plan 3.0 dB"]),
        # what ought to be zero is worse than anything finite
        (found(bev=-60.0, empty=-math.inf), ["empty -inf dB", "bev -60.0 dB"]),
        (found(labels=-3.0), []),
        (
            Fidelity((OutputFidelity("y", 31.0, 0.0, False, 19.0),), (), None, "", 6),
            ["y in its noisiest frame 19.0 dB"],
        ),
    ],
)
def test_what_is_below_the_floor_is_listed_the_worst_first(
    measured: Fidelity, below: list[str]
) -> None:
    shortfalls = Floor(20.0).shortfalls(measured)

    assert [str(each) for each in shortfalls] == below
    assert all(0 < each.excess < math.inf for each in shortfalls)
    (bev,) = Floor(20.0).shortfalls(found(bev=0.0))
    assert bev.excess == pytest.approx(10.0)


def test_sets_are_judged_by_their_matched_agents() -> None:
    agents = SetFidelity(9, 9, {"boxes": 30.0, "scores": 11.0})
    below = Floor().shortfalls(found(boxes=0.1, scores=0.2, bev=1.0), agents)

    assert [str(each) for each in below] == [
        "bev 1.0 dB",
        "scores of matched agents 11.0 dB",
    ]


# Agents in another order are the same agents.


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


def test_agents_are_matched_where_they_are_near_and_sure() -> None:
    here = outputs(BOXES, SCORES)
    near, far = BOXES.copy(), BOXES.copy()
    near[0, 1], far[0, 0] = 1.0, 40.0

    found = matched(here, outputs(near[::-1], SCORES[::-1]))
    signal = float((BOXES[:3] ** 2).sum())
    assert found.sqnr_db["boxes"] == pytest.approx(10 * math.log10(signal))
    found = matched(here, outputs(far, SCORES))
    assert (found.agents, found.matched) == (3, 2)
    unsure = outputs(BOXES, SCORES / 10)
    assert matched(unsure, unsure) == SetFidelity(0, 0, {})


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
def test_compare_takes_what_both_graphs_have(tmp_path: Path, has_scores: bool) -> None:
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
    (outputs,) = found.view().tables
    if has_scores:
        assert found.agents is not None
        assert found.agents.sqnr_db["boxes"] == math.inf
        texts = [each.text for each in outputs.rows[0]]
        assert texts == ["boxes", "inf", "matched agents", ""]
    else:
        assert found.agents is None
        assert outputs.rows[0][1].text == f"{found.fidelity.outputs[0].sqnr_db:.1f}"


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
