"""Loops that constants keep going are refused; those that may end are not."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.runtime.runnable import endless
from me2e_compress.runtime.session import Session
from tests.nets import parsed

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
def test_a_loop_without_end_is_not_run(model: ir.Model) -> None:
    with pytest.raises(GraphError, match="'loop' goes on for more than 16,777,216"):
        Session(model)


@pytest.mark.parametrize(
    "model",
    [loop(2**62, MAY_END), loop(100), loop(2**62, first=0)],
    ids=["it may end", "few rounds", "it never begins"],
)
def test_a_loop_that_may_end_is_run(model: ir.Model) -> None:
    assert endless(model) is None


def test_a_file_with_a_loop_without_end_is_not_run(tmp_path: Path) -> None:
    graph.save(loop(2**62), tmp_path / "m.onnx")
    with pytest.raises(GraphError, match="'loop' goes on"):
        Session(tmp_path / "m.onnx")


INNER = """b = Loop (most, first, a) <body = inner (
            int64 i, bool c, float[4] d
        ) => (bool e, float[4] f) {
            f = Relu(d)
            e = Identity(c)
        }>"""


def test_loops_in_loops_count_together() -> None:
    text = LOOP.format(most=1 << 13, on=SAME, rounds="most", first=1)
    assert endless(parsed(text)) is None
    assert endless(parsed(text.replace("b = Relu(a)", INNER)))
