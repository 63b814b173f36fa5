"""What fits and what is missing, said before anything drives."""

import json
from pathlib import Path

import pytest

from me2e_compress import check_model
from me2e_compress.base.errors import EvaluationError
from me2e_compress.commands.evaluate import ModelCheck
from me2e_compress.commands.options import GraphOptions
from tests.evaluators.highway.drivers import straight_on

IMAGE = {
    "me2e.image": json.dumps(
        {"mean": [0, 0, 0], "std": [1, 1, 1], "order": "rgb", "input": "img"}
    )
}


def tcp_like(path: Path) -> Path:
    """Write a graph with three heads and a state, of one camera's image."""
    return straight_on(
        path,
        inputs="float[1, 3, 16, 24] img, float[1, 3] state, float[1, 2] memory",
        outputs="float[1, 4, 2] wp, float[1, 3] action, float[1, 2] memory_out,"
        " float[1] value",
        body="""wp = Slice (ahead, from, to, axes)
            action = Mul (state, none)
            memory_out = Identity (memory)
            value = Identity (one)""",
        initializers=""", int64[1] from = {0}, int64[1] to = {4},
            int64[1] axes = {1}, float[1] none = {0.0}, float[1] one = {1.0}""",
        metadata=IMAGE,
    )


ADAPTER = """
[images.img]
cameras = ["FRONT"]

[feeds.state]
parts = [{source = "speed", std = 12.0}, {source = "target-point"}]

"""
PLAN = """
[plan]
output = "wp"
step_s = 0.5
"""


def checked(tmp_path: Path, adapter: str | None = ADAPTER + PLAN) -> ModelCheck:
    model = tcp_like(tmp_path / "m.onnx")
    if adapter is None:
        return check_model(model)
    (tmp_path / "a.toml").write_text(adapter)
    return check_model(model, GraphOptions(adapter=tmp_path / "a.toml"))


def test_every_port_and_its_part(tmp_path: Path) -> None:
    found = checked(tmp_path)

    assert not found.problems
    assert found.status == "ok"
    assert [(each.name, each.use) for each in found.inputs] == [
        ("img", "FRONT"),
        ("state", "speed, target-point"),
        ("memory", "memory_out of the frame before"),
    ]
    assert [(each.name, each.use) for each in found.outputs] == [
        ("wp", "the plan"),
        ("action", None),
        ("memory_out", "fed back to memory"),
        ("value", None),
    ]


def test_all_that_is_missing_is_told_at_once(tmp_path: Path) -> None:
    found = checked(tmp_path, None)

    assert found.problems
    assert found.status == "refused"
    image, state, plan = found.problems
    assert "img" in image
    assert "the adapter has no [feeds.state]" in state
    assert "the model has no output plan" in plan
    assert [bool(each.problem) for each in found.inputs] == [True, True, False]
    with pytest.raises(EvaluationError, match=r"m.onnx could not drive: .*img"):
        found.check()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("std = 12.0}, {source", "std = 12.0}, {source = 'speed'}, {source", "state"),
        ("step_s = 0.5", "", "step_s must say how far apart"),
        ('output = "wp"', 'output = "value"', r"value has shape \[1\], a plan is"),
        ('"wp"', '"way"', "no output way, which is named as the plan"),
    ],
)
def test_what_does_not_fit(tmp_path: Path, old: str, new: str, message: str) -> None:
    adapter = (ADAPTER + PLAN).replace(old, new)
    (problem,) = checked(tmp_path, adapter).problems

    assert message.replace("\\", "") in problem


def test_what_is_no_graph_is_opened_or_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="no such file"):
        check_model(tmp_path / "no.onnx")
    with pytest.raises(EvaluationError, match="No such file"):
        check_model(
            tcp_like(tmp_path / "m.onnx"), GraphOptions(adapter=tmp_path / "no.toml")
        )
    assert not check_model("blind:6").problems
    with pytest.raises(EvaluationError, match="No module named 'nowhere_at_all'"):
        check_model("nowhere_at_all:make")
