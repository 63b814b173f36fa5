"""An engine's dump against its graph: what was lost, where, and who is to blame."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import EvaluationError, GraphError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.compare_dump import DumpResult, compare_dump
from me2e_compress.commands.options import CompareOptions
from me2e_compress.runtime.session import Session
from tests.fidelity.engines import Arrays, drive, frames, noisy, stack
from tests.support.command import Command
from tests.support.frames import record
from tests.support.nets import parsed

QUANTIZED = """
small (float[1,8] x) => (float[1,8] y)
<float scale = {0.5}, int8 zero = {0}> {
    q = QuantizeLinear(x, scale, zero)
    y = DequantizeLinear(q, scale, zero)
}
"""
FLOAT = """
small (float[1,8] x) => (float[1,8] y) { y = Identity(x) }
"""


@pytest.fixture
def files(tmp_path: Path) -> Path:
    model = stack()
    model.metadata_props["me2e.recurrent"] = json.dumps({"prev": "prev_out"})
    ir.save(model, tmp_path / "m.onnx")
    shown = [each.arrays for each in frames()]
    record(tmp_path / "frames", shown, (0, 4))
    return tmp_path


def dumped(files: Path, answers: list[Arrays]) -> Path:
    return record(files / "dump", answers)


def answered(files: Path) -> list[Arrays]:
    session = Session(files / "m.onnx")
    return drive(session, list(CalibrationSet(files / "frames")))


def found_in(files: Path, **given: Any) -> DumpResult:
    return compare_dump(files / "m.onnx", files / "dump", files / "frames", **given)


def test_what_is_left_is_the_compilers(files: Path) -> None:
    dumped(files, noisy(answered(files), 30.0))

    found = found_in(files)

    assert found.headline.startswith(
        "compilation: the engine, or its host, does not answer as its graph does"
    )
    assert found.state == "the engine's own"
    for each in found.outputs:
        assert each.compilation_db == pytest.approx(30.0, abs=3)
        assert each.all_db == each.compilation_db
        assert each.quantization_db is None
    assert found.float_reason == "m.onnx is not quantized"


def test_an_engine_that_answers_as_its_graph(files: Path) -> None:
    dumped(files, answered(files))
    found = found_in(files)
    assert found.headline.startswith("the engine answers as its graph does")
    assert (found.status, found.alerts()) == ("ok", ())
    assert found.inner is None  # outputs alone tell nothing of the inside


def test_a_plan_that_rests_is_dead_though_all_else_is_right(
    files: Path, command: Command
) -> None:
    shown = answered(files)
    dumped(files, [each | {"plan": shown[0]["plan"]} for each in shown])

    found = found_in(files)

    assert found.status == "refused"
    assert found.alerts() == ("plan is constant: it moves 0.00% as far as before",)
    assert {each.name: each.moves for each in found.outputs} == {
        "plan": 0.0, "boxes": pytest.approx(1), "prev_out": pytest.approx(1),
    }  # fmt: skip
    with pytest.raises(EvaluationError, match="dump: plan is constant"):
        found.check()
    unasked = found_in(files, options=CompareOptions(alive=0.0))
    assert unasked.alerts() == ()
    words = files / "m.onnx", files / "frames", "--outputs", files / "dump"
    assert command("compare", *words) == 1
    assert command("compare", *words, "--alive", "0") == 0


def test_quantization_is_what_the_graph_lost_to_its_source(tmp_path: Path) -> None:
    ir.save(parsed(QUANTIZED), tmp_path / "small.onnx")
    ir.save(parsed(FLOAT), tmp_path / "source.onnx")
    shown = np.array([[0.1, 0.7, 1.2, 2.1, -0.6, -1.7, 0.3, 1.1]], np.float32)
    record(tmp_path / "frames", [{"x": shown}])
    record(tmp_path / "dump", [{"y": np.round(shown / 0.5).astype(np.float32) / 2}])
    small, dump, shown_at = (tmp_path / e for e in ("small.onnx", "dump", "frames"))

    unknown = compare_dump(small, dump, shown_at)
    given = compare_dump(small, dump, shown_at, float_graph=tmp_path / "source.onnx")

    assert unknown.outputs[0].quantization_db is None
    assert "--float names no source" in unknown.float_reason
    lost = given.outputs[0]
    assert lost.compilation_db == np.inf
    assert lost.quantization_db == lost.all_db
    assert lost.quantization_db is not None
    assert 15 < lost.quantization_db < 25


def test_state_comes_from_our_own_run_where_the_dump_has_none(files: Path) -> None:
    kept = [{k: v for k, v in e.items() if k != "prev_out"} for e in answered(files)]
    dumped(files, kept)
    found = found_in(files)
    assert found.state == "of our own run: prev"
    assert found.headline.startswith("the engine answers as its graph does")
    assert found.notes[0] == "not dumped: prev_out"


def test_with_the_engines_state_errors_do_not_add_up(files: Path) -> None:
    session, shown = Session(files / "m.onnx"), list(CalibrationSet(files / "frames"))
    given = drive(session, shown[:2])
    given[1]["prev_out"] = np.random.default_rng(5).normal(size=(1, 16)).astype("f4")
    dumped(files, drive(session, shown[2:], given))

    plan, boxes, state = found_in(files).outputs

    assert min(plan.compilation_db, boxes.compilation_db) > 100
    assert state.compilation_db < 10


def test_tensors_inside_the_graph_tell_where_it_begins(files: Path) -> None:
    model = ir.load(files / "m.onnx")
    weight = model.graph.initializers["w_all"]
    assert weight.const_value is not None
    rolled = np.roll(weight.const_value.numpy(), 1, axis=1)
    weight.const_value = ir.tensor(rolled, name="w_all")
    inner = ("own", "mixed")
    model.graph.outputs.extend(
        each for node in model.graph for each in node.outputs if each.name in inner
    )
    shown = list(CalibrationSet(files / "frames"))
    dumped(files, drive(Session(model), shown))

    found = found_in(files)

    assert found.inner is not None
    assert found.inner.first is not None
    assert found.inner.first.value == "mixed"
    assert found.lines()[1].startswith("inside: first below 20 dB: module model, ")


def spoiled(answers: list[Arrays], value: float) -> list[Arrays]:
    answers[3]["boxes"][0, 2, 4] = value
    return answers


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: [{"wp": e["plan"]} for e in a], "the dump is of another graph"),
        (lambda a: [e | {"wp": e["plan"]} for e in a], "wp is no tensor of"),
        (
            lambda a: [e | {"plan": e["plan"][:, :1]} for e in a],
            "/dump: output plan is [1, 1, 2] in the dump at frame 0, [1, 4, 2] in the"
            " graph",
        ),
        (
            lambda a: [e | {"prev_out": e["prev_out"][:, :3]} for e in a],
            "output prev_out is [1, 3] in the dump",
        ),
        (
            lambda a: spoiled(a, np.inf),
            "/dump: output boxes of the dump is infinite at frame 3, [0, 2, 4]",
        ),
        (lambda a: spoiled(a, np.nan), "boxes of the dump is NaN at frame 3, [0, 2"),
    ],
)
def test_a_dump_that_is_not_of_the_graph(
    files: Path, change: Callable[[list[Arrays]], list[Arrays]], words: str
) -> None:
    dumped(files, change(answered(files)))

    with pytest.raises(EvaluationError) as caught:
        found_in(files)

    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_such_float_source(files: Path) -> None:
    dumped(files, answered(files))
    with pytest.raises(GraphError, match=r"none\.onnx: no such file"):
        found_in(files, float_graph="none.onnx")
