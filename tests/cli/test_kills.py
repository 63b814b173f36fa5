"""Kills, Ctrl-C and SIGTERM: files are whole, the user's stay, one line is said."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path

import onnx
import pytest

import me2e_compress
from me2e_compress import graph
from tests.support.command import Cli, contents

WRITES = ("replace", "link", "unlink", "rmdir")
COMMANDS = {
    "compress": "compress dense.onnx -o out.onnx -r full --frames frames",
    "sensitivity": "sensitivity dense.onnx frames -o out.toml --map map.toml",
}
BOTH = pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)]
)


def copies(patch: pytest.MonkeyPatch, folder: Path, place: Path) -> list[Path]:
    """Copy a folder before every write in it, as a kill would leave it."""
    made = list[Path]()

    def first(name: str) -> Callable[..., object]:
        real = getattr(os, name)

        def call(*given: object, **options: object) -> object:
            if str(folder) in str(Path(str(given[0])).absolute()):
                made.append(shutil.copytree(folder, place / str(len(made))))
            return real(*given, **options)

        return call

    for name in WRITES:
        patch.setattr(os, name, first(name))
    return made


def without_times(folder: Path) -> dict[str, bytes]:
    """Read what is the same in each run."""
    return {
        name: content
        for name, content in contents(folder).items()
        if not name.startswith(".") and not name.endswith(".report.json")
    }


def check_whole(folder: Path) -> None:
    """Fail where a file that is not hidden is none."""
    for path in folder.iterdir():
        if path.suffix == ".onnx":
            graph.load(path)
        elif path.suffix == ".json" and not path.name.startswith("."):
            json.loads(path.read_text())


@pytest.mark.parametrize("name", COMMANDS)
def test_a_kill_at_any_write_leaves_whole_files_and_the_next_run_works(
    cli: Cli,
    dense: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:
    line = COMMANDS[name]
    (dense / "mine.txt").write_text("mine")
    cli.done(line)  # what is replaced is there
    first = without_times(dense)
    with pytest.MonkeyPatch.context() as patch:
        left = copies(patch, dense, tmp_path_factory.mktemp("killed"))
        cli.done(line)
    assert left
    for folder in left:
        check_whole(folder)
        monkeypatch.chdir(folder)
        cli.done(line)
        assert without_times(folder).items() >= first.items()


@pytest.fixture
def hears_ctrl_c() -> Iterator[None]:
    """Undo that what a script starts in the background, as these tests, ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.opens_apart
@pytest.mark.usefixtures("hears_ctrl_c", "files")
@BOTH
@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("calibrate in.onnx frames -o out", "interrupted; run again to go on"),
        ("compare in.onnx in.onnx frames", "interrupted"),
        (
            "frames in.onnx -o out",
            "interrupted; run again to go on after the last whole scene, if there is"
            " one",
        ),
    ],
)
def test_it_ends_in_one_line(
    cli: Cli,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
    code: int,
    line: str,
    said: str,
) -> None:
    def interrupted(path: Path) -> None:
        signal.raise_signal(number)
        time.sleep(60)  # another thread may have got it first

    monkeypatch.setattr("me2e_compress.graph.load", interrupted)
    before = signal.getsignal(signal.SIGTERM)

    ended = cli(line)

    assert (ended.code, ended.err) == (code, f"me2e-compress: {said}\n")
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.usefixtures("hears_ctrl_c")
@BOTH
def test_a_signal_that_python_loses_ends_the_run_all_the_same(
    cli: Cli,
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

    monkeypatch.setattr("me2e_compress.graph.load", lose)
    before, hook = sorted(files.iterdir()), sys.unraisablehook

    assert cli("compress in.onnx -o out.onnx -r exact").code == code

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
signals.TIMEOUT_S = 0.2
session = ort.InferenceSession(sys.argv[1])
with signals.handle_signals():
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
