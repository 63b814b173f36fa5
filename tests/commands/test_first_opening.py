"""Opened in a process of its own, once."""

import gc
import subprocess
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.commands import checks
from me2e_compress.commands.checks import shortcomings, try_first
from me2e_compress.commands.compress import compress
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager
from me2e_compress.manager.recipe import parse
from me2e_compress.manager.verification_inputs import Answers, VerificationInputs
from me2e_compress.passes import Context
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session
from tests.support.nets import save_text
from tests.support.stacks import write_stack

pytestmark = pytest.mark.opens_apart


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of verdicts."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "me2e-compress" / "opened"


def test_a_graph_that_survived_is_not_tried_again(
    driver: ir.Model, opened: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends: list[str] = []

    def noted(script: Path, words: list[str]) -> "subprocess.CompletedProcess[str]":
        done = run_script(script, words)
        ends.append(done.stdout)
        return done

    monkeypatch.setattr(checks, "run_script", noted)
    camera: dict[str, Array] = {"camera": np.zeros((1, 4), np.float32)}
    camera["file"] = np.zeros(1)  # a name that numpy's savez takes for its own
    frames = [Frame(0, True, camera)]

    try_first(driver, "driver", listener=SILENT)
    try_first(driver, "driver", listener=SILENT)
    assert ends == ["open\n"]
    try_first(driver, "driver", frames, listener=SILENT)
    try_first(driver, "driver", frames, listener=SILENT)
    try_first(driver, "driver", listener=SILENT)
    assert ends == ["open\n", "open\nrun\n"]

    (verdict,) = opened.iterdir()
    verdict.write_text("{" * 9)  # no verdict at all
    try_first(driver, "driver", frames, listener=SILENT)
    assert len(ends) == 3


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (-9, "was killed (out of memory?) at step run"),
        (-11, "dies of it (SIGSEGV) at step run"),
        (3221225477, "dies of it (exit code 3221225477) at step run"),
    ],
)
@pytest.mark.parametrize("as_file", [False, True])
def test_how_it_died(
    driver: ir.Model,
    tmp_path: Path,
    opened: Path,
    monkeypatch: pytest.MonkeyPatch,
    code: int,
    said: str,
    as_file: bool,
) -> None:
    dead = subprocess.CompletedProcess([], code, "open\nrun\n", "")
    monkeypatch.setattr(checks, "run_script", lambda script, words: dead)
    source = write_stack(tmp_path).with_name("head.onnx") if as_file else driver

    with pytest.raises(GraphError) as caught:
        try_first(source, "driver.onnx", listener=SILENT)

    assert str(caught.value) == f"driver.onnx: onnxruntime {said}"
    assert not opened.exists()


def test_a_file_that_cannot_be_read_is_left_to_who_opens_it(tmp_path: Path) -> None:
    try_first(tmp_path / "none.onnx", "none.onnx", listener=SILENT)


def test_a_run_that_kills_onnxruntime_is_named(opened: Path) -> None:
    """It divides the least integer by -1, and nothing but a run shows it."""
    model = ir.from_onnx_text("""
        <ir_version: 8, opset_import: ["" : 17]>
        deadly (int32[1] x, int32[1] by) => (int32[1] y) { y = Div(x, by) }
    """)
    arrays: dict[str, Array] = {"x": np.array([-(2**31)], np.int32)}
    arrays["by"] = np.array([-1], np.int32)

    with pytest.raises(GraphError, match=r"dies of it \(SIGFPE\) at step run"):
        try_first(model, "deadly", [Frame(0, True, arrays)], listener=SILENT)
    assert not opened.exists()


def test_seeded_inputs_are_run_apart_too(opened: Path, tmp_path: Path) -> None:
    """Whole numbers are drawn as 0 or 1."""
    text = """deadly (int32[1] x) => (int32[1] y)
        <int32[1] two = {2}, int32[1] least = {-2147483648}, int32[1] minus = {-1}>
        { none = Div(x, two) low = Add(none, least) y = Div(low, minus) }"""
    model = save_text(tmp_path / "m.onnx", text)

    with pytest.raises(GraphError, match=r"m.onnx: onnxruntime dies of it \(SIGFPE"):
        compress(model, tmp_path / "small.onnx", "exact")

    manager = PassManager(
        parse("import-normalize"), try_first=partial(try_first, listener=SILENT)
    )
    with pytest.raises(GraphError, match=r"import-normalize: onnxruntime dies of it"):
        manager.run(graph.load(model), Context(ModuleMap.whole()))


SUM = """<ir_version: 8, opset_import: ["" : 17]>
    sum (float[1] x, float[1] prev_s) => (float[1] y, float[1] next_s)
    <float one = {1.0}> { next_s = Add(x, prev_s) z = Abs(x) y = Mul(z, next_s) }"""


def answers_apart(text: str) -> tuple[ir.Model, list[Frame], Answers]:
    """What a graph answered apart to at most three of frames in two scenes."""
    arrays = ({"x": np.array([value], np.float32)} for value in range(1, 5))
    frames = [Frame(at, at in (0, 2), dict(each)) for at, each in enumerate(arrays)]
    model, known = ir.from_onnx_text(text), Answers()
    try_first(model, "m", frames, listener=SILENT, count=3, answers=known)
    return model, frames, known


@pytest.mark.usefixtures("opened")
def test_a_proof_runs_no_graph_on_frames_that_it_answered_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A state goes on from frame to frame; nothing is known of the second scene."""
    model, frames, known = answers_apart(SUM)
    others = [frames[0], replace(frames[1], arrays={"x": np.ones(1, np.float32)})]
    scenes = [frames[0], replace(frames[1], starts_scene=True)]
    for shown, sums in ((frames, [1, 6, 9, 28]), (others, [1, 2]), (scenes, [1, 4])):
        inputs = VerificationInputs(shown, "recorded", answers=known)
        assert [each["y"].item() for each in inputs.run(model)] == sums
    monkeypatch.delattr("me2e_compress.manager.verification_inputs.Session")
    inputs = VerificationInputs(frames[:2], "recorded", answers=known)
    assert [each["y"].item() for each in inputs.run(model)] == [1, 6]
    with pytest.raises(NameError):
        next(iter(inputs.run(model, optimize=False)))


@pytest.mark.usefixtures("opened")
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("z = Abs(x)", "z = RandomNormalLike(x)"),
        ("z = Abs(x)", "q = QuantizeLinear(x, one) z = DequantizeLinear(q, one)"),
        ("(float[1] y", "(float[] y"),
    ],
)
def test_what_a_session_may_answer_otherwise_is_not_kept(old: str, new: str) -> None:
    """Random numbers, int8, and a state that only a session may know."""
    assert not answers_apart(SUM.replace(old, new))[2]


HALF = """<ir_version: 10, opset_import: ["" : 23]>
    half (float16[4,32] x) => (float16[4,16] y)
    <int8[32,16] w = {{{}}}, float[2,16] s = {{{}}}> {{
        ["/head/Scales"] h = DequantizeLinear<axis=0, block_size=16, output_dtype=10>(
            w, s)
        ["/head/MatMul"] y = MatMul(x, h)
    }}""".format(", ".join(["3"] * 512), ", ".join(["0.125"] * 32))
"""onnxruntime (1.32) makes a MatMulNBits of it, whose types it then refuses."""


def test_what_only_the_optimizer_refuses_is_run_as_it_stands_and_told(
    opened: Path, tmp_path: Path
) -> None:
    path = save_text(tmp_path / "half.onnx", HALF)
    told = list[str]()
    for _ in range(2):
        try_first(path, "half.onnx", listener=Listener(on_warning=told.append))
    assert len(told) == 2
    assert told[0].startswith("half.onnx: only onnxruntime's optimizer refuses it (")
    x = np.ones((4, 32), np.float16)
    assert np.all(Session(path, int8_kernels=True).run({"x": x})["y"] == 12)
    with pytest.raises(GraphError, match="MatMulNBits"):
        Session(path, int8_kernels=True, rewritten=tmp_path / "written.onnx")


def test_a_session_that_opened_at_a_second_try_is_freed_without_the_collector(
    tmp_path: Path,
) -> None:
    path = save_text(tmp_path / "half.onnx", HALF)
    gc.disable()  # as `compress` does
    try:
        session = weakref.ref(Session(path, int8_kernels=True))
        assert session() is None
    finally:
        gc.enable()


def test_layers_in_functions_are_counted_as_often_as_they_are_called() -> None:
    model = ir.from_onnx_text("""<ir_version: 10, opset_import: ["" : 18, "own" : 1]>
        m (float[4,4] x, float[4,4] k) => (float[4,4] y)
            { a = own.Two(x, k) b = own.One(a, k) y = MatMul(b, k) }
        <opset_import: ["" : 18, "own" : 1], domain: "own">
        Two (x, k) => (y) { a = own.One(x, k) y = own.One(a, k) }
        <opset_import: ["" : 18], domain: "own">
        One (x, k) => (y) { a = MatMul(x, k) y = Relu(a) }""")
    hint = shortcomings(model)
    assert hint.startswith("3 layers in functions of the file (own::Two, own::One), ")
    assert "python -c 'import onnx, onnx.inliner as i; onnx.save(" in hint
    model.functions.clear()
    assert "layer" not in shortcomings(model)
