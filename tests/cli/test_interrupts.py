"""Ctrl-C and SIGTERM: one line, and the exit code that shells know."""

import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from pathlib import Path

import onnx
import pytest

import me2e_compress
from tests.cli.conftest import Command


@pytest.fixture
def hears_ctrl_c() -> Iterator[None]:
    """Undo that what a script starts in the background, as these tests, ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("hears_ctrl_c")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)]
)
@pytest.mark.parametrize(
    ("name", "words", "said"),
    [
        ("calibrate", "in.onnx frames -o out", "interrupted; run again to go on"),
        ("compare", "in.onnx in.onnx frames", "interrupted"),
        (
            "frames",
            "in.onnx -o out",
            "interrupted; run again to go on after the last whole scene, if there is"
            " one",
        ),
    ],
)
def test_it_ends_in_one_line(
    command: Command,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: signal.Signals,
    code: int,
    name: str,
    words: str,
    said: str,
) -> None:
    def interrupted(path: Path) -> None:
        signal.raise_signal(number)
        time.sleep(60)  # another thread may have got it first

    monkeypatch.chdir(files)
    monkeypatch.setattr("me2e_compress.graph.files.load", interrupted)
    before = signal.getsignal(signal.SIGTERM)

    assert command(name, *words.split()) == code

    assert capsys.readouterr().err == f"me2e-compress: {said}\n"
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.usefixtures("hears_ctrl_c")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)]
)
def test_a_signal_that_python_loses_ends_the_run_all_the_same(
    command: Command,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
    code: int,
) -> None:
    """What is raised in a weak reference's callback goes no further."""

    class Large:
        pass

    def lose(path: Path) -> None:
        large = Large()
        kept = weakref.ref(large, lambda _: signal.raise_signal(number))
        del large
        assert kept() is None
        for _ in range(500):
            time.sleep(0.01)

    monkeypatch.chdir(files)
    monkeypatch.setattr("me2e_compress.graph.files.load", lose)
    before, hook = sorted(files.iterdir()), sys.unraisablehook

    assert command("compress", "in.onnx", "-o", "out.onnx", "-r", "exact") == code

    assert sorted(files.iterdir()) == before
    assert sys.unraisablehook is hook


def test_processes_are_started_in_one_place_alone() -> None:
    words = ("get_context(", "subprocess.run(", "Popen(", "ProcessPoolExecutor(")
    package = Path(me2e_compress.__file__).parent

    found = [
        str(path.relative_to(package))
        for path in package.rglob("*.py")
        if any(word in path.read_text(encoding="utf-8") for word in words)
    ]

    assert found == [str(Path("runtime", "children.py"))]


ENDLESS = """
<ir_version: 9, opset_import: ["" : 17]>
endless (int64[1] x) => (int64[1] y) <int64 most = {9223372036854775807}> {
    go = Equal (x, x)
    first = Squeeze (go)
    y = Loop (most, first, x) <body = body (int64 i, bool c, int64[1] a) => (
        bool again, int64[1] b
    ) { same = Equal (a, a) again = Squeeze (same) b = Identity (a) }>
}
"""
DEAF = """
import sys, numpy as np, onnxruntime as ort
from me2e_compress.cli import signals
signals.DEAF_S = 0.2
session = ort.InferenceSession(sys.argv[1])
with signals.signals_in_order():
    print("runs", flush=True)
    session.run(None, {"x": np.zeros(1, np.int64)})
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_graph_that_never_ends_ends_with_the_signal(
    tmp_path: Path, number: signal.Signals
) -> None:
    onnx.save(onnx.parser.parse_model(ENDLESS), tmp_path / "endless.onnx")
    words = [sys.executable, "-c", DEAF, str(tmp_path / "endless.onnx")]
    with subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "runs\n"
        time.sleep(0.2)
        process.send_signal(number)
        _, said = process.communicate(timeout=30)

    assert process.returncode == 128 + number
    assert said == "me2e-compress: interrupted\n"
