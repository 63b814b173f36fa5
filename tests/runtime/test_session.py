from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.graph.nodes import constant_values
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.runnable import why_endless
from me2e_compress.runtime.session import Session, feed_forward, replay
from me2e_compress.targets.weights import evaluate_constants
from tests.support.nets import parsed

COUNTER = """
counter (float[1,2] x, float[1,2] memory) => (float[1,2] y, float[1,2] memory_out) {
    memory_out = Add(x, memory)
    y = Identity(memory_out)
}
"""


@pytest.fixture
def counter() -> ir.Model:
    return parsed(COUNTER)


def ones(index: int, starts: bool) -> Frame:
    return Frame(index, starts, {"x": np.ones((1, 2), np.float32)})


def sums(
    counter: ir.Model, frames: list[Frame], state: Mapping[str, Array] | None = None
) -> list[float]:
    replayed = feed_forward(Session(counter), frames, ["y"], state)
    return [float(values["y"].item(0)) for _, values, _ in replayed]


def test_state_is_fed_forward_reset_where_a_scene_starts_and_given_within(
    counter: ir.Model,
) -> None:
    frames = [ones(0, True), ones(1, False), ones(2, False), ones(3, True)]
    assert sums(counter, frames) == [1, 2, 3, 1]
    state = {"memory": np.full((1, 2), 5, np.float32)}
    assert sums(counter, frames[1:], state) == [6, 7, 1]


def test_a_scene_may_open_with_a_state_of_its_own(counter: ir.Model) -> None:
    start = {**ones(0, True).arrays, "memory": np.full((1, 2), 10, np.float32)}
    later = {**ones(1, False).arrays, "memory": np.full((1, 2), 99, np.float32)}

    assert sums(counter, [Frame(0, True, start), Frame(1, False, later)]) == [11, 12]


def test_metadata_decides_what_is_fed_back(counter: ir.Model) -> None:
    counter.metadata_props["me2e.recurrent"] = "{}"

    with pytest.raises(FramesError, match=r"frame 0: input memory is missing.* x"):
        list(replay(Session(counter), [ones(0, True)]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "not JSON"),
        ('["memory"]', "is not {input: output}"),
        ('{"memory": "nowhere"}', "nowhere.*outputs y, memory_out"),
        ('{"missing": "y"}', "missing.*inputs x, memory"),
    ],
)
def test_metadata_that_pairs_nothing_is_refused(
    counter: ir.Model, text: str, message: str
) -> None:
    counter.metadata_props["me2e.recurrent"] = text

    with pytest.raises(GraphError, match=message):
        Session(counter)


def test_state_of_open_shape_needs_a_first_value() -> None:
    model = parsed(COUNTER.replace("float[1,2] memory", "float[n,2] memory"))

    with pytest.raises(GraphError, match=r"memory .*nothing gives n a size: .*n=1"):
        list(replay(Session(model), [ones(0, True)]))


def test_an_output_that_numpy_cannot_hold_is_an_error_of_the_graph() -> None:
    model = parsed("m (float[2] x) => (bfloat16[2] y) { y = Cast<to=16>(x) }")

    with pytest.raises(GraphError, match=r"onnxruntime failed: .* bfloat16"):
        Session(model).run({"x": np.ones(2, np.float32)})


def test_a_wrong_shape_is_an_error_of_the_frame(counter: ir.Model) -> None:
    wrong = {"x": np.ones((1, 3), np.float32), "memory": np.ones((1, 2), np.float32)}

    with pytest.raises(FramesError, match="Got: 3 Expected: 2"):
        Session(counter).run(wrong)


def test_what_no_input_changes_is_constant_and_can_be_computed() -> None:
    model = parsed("""
    layer (float[1,2] x) => (float[1,3] y, float[2] noise)
    <float[3,2] w = {1.0, 2.0, 3.0, 4.0, 5.0, 6.0}> {
        turned = Transpose(w)
        y = MatMul(x, turned)
        noise = RandomNormal<shape=[2]>()
    }
    """)

    model.metadata_props["me2e.recurrent"] = '{"x": "y"}'

    names = {value.name for value in constant_values(model)}

    assert names == {"w", "turned"}
    np.testing.assert_array_equal(
        evaluate_constants(model, ["turned"])["turned"], [[1, 3, 5], [2, 4, 6]]
    )


def test_the_graph_as_onnxruntime_rewrites_it_computes_the_same(tmp_path: Path) -> None:
    model = parsed(
        "m (float[2] x) => (float[2] y) { a = Identity(x) b = Identity(a) y = Relu(b) }"
    )
    path = tmp_path / "rewritten.onnx"
    Session(model, rewritten=path)

    again = Session(path, optimize=False).run({"x": np.array([-1, 2], np.float32)})

    assert again["y"].tolist() == [0, 2]
    assert [node.op_type for node in ir.load(path).graph] == ["Relu"]


# Loops that constants keep going are refused; those that may end are not.


LOOP = """
g (float[4] x) => (float[4] y)
<bool first = {{{first}}}, int64 most = {{{most}}}> {{
    ["loop"] y = Loop ({rounds}, first, x) <body = round (
        int64 at, bool before, float[4] a
    ) => (bool on, float[4] b) {{
        b = Relu(a)
        {on}
    }}>
}}
"""
SAME, TRUE = "on = Identity(before)", "on = Constant<value = bool {1}>()"
MAY_END = "s = ReduceSum<keepdims = 0>(b) z = Sub(s, s) on = Less(z, s)"


def loop(most: int, on: str = SAME, rounds: str = "most", first: int = 1) -> ir.Model:
    return parsed(LOOP.format(most=most, on=on, rounds=rounds, first=first))


@pytest.mark.parametrize(
    "model",
    [loop(2**62), loop(2**62, TRUE), loop(1, rounds=""), loop(1, TRUE, rounds="")],
    ids=["same", "true", "no limit", "true without limit"],
)
def test_a_loop_without_end_is_not_run(model: ir.Model, tmp_path: Path) -> None:
    graph.save(model, tmp_path / "m.onnx")
    for source in (model, tmp_path / "m.onnx"):
        with pytest.raises(GraphError, match="'loop' goes on for more than 16,777,216"):
            Session(source)


@pytest.mark.parametrize(
    "model",
    [loop(2**62, MAY_END), loop(100), loop(2**62, first=0)],
    ids=["it may end", "few rounds", "it never begins"],
)
def test_a_loop_that_may_end_is_run(model: ir.Model) -> None:
    assert why_endless(model) is None


INNER = """b = Loop (most, first, a) <body = inner (
            int64 i, bool c, float[4] d
        ) => (bool e, float[4] f) {
            f = Relu(d)
            e = Identity(c)
        }>"""


def test_loops_in_loops_count_together() -> None:
    text = LOOP.format(most=1 << 13, on=SAME, rounds="most", first=1)
    assert why_endless(parsed(text)) is None
    assert why_endless(parsed(text.replace("b = Relu(a)", INNER)))
