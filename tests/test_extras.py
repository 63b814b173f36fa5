"""What is said where an extra is not installed, or only half."""

import pickle
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from me2e_compress.cli import main
from me2e_compress.errors import (
    BrokenPackageError,
    MissingExtraError,
    MissingPackageError,
)
from me2e_compress.extras import MODULES, explained, need_extra

ROOT = Path(__file__).parents[1]


def commands() -> Mapping[str, tuple[str, ...]]:
    """Return words that need an extra, by the module of it that is broken."""
    frames = str(ROOT / "me2e_compress/shipped/weights/highway-frames")
    return {
        "highway_env": ("evaluate", "blind", "--routes", "1", "-o", "out"),
        "cv2": ("evaluate", "highway", "--routes", "1", "-o", "out"),
        "matplotlib": (
            *("profile", "highway", frames, "-o", "t.json"),
            *("--samples", "1", "--figure", "f.png"),
        ),
        "jinja2": ("study", "smoke", "-o", "out", "--dry-run"),
        "ray": (*("evaluate", "blind", "--routes", "1", "--engine", "ray"), "-o", "o"),
        "tensorrt_rtx": ("lint", "highway", "--target", "tensorrt", "--trt-check"),
    }


@pytest.mark.parametrize(("module", "words"), commands().items())
def test_a_half_installed_extra_is_one_line(
    tmp_path: Path, module: str, words: tuple[str, ...]
) -> None:
    """The module is found; importing it fails."""
    reason = "libGL.so.1: cannot open shared object file"
    package = tmp_path / "site" / module
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(f"raise ImportError({reason!r})\n")
    done = subprocess.run(
        [sys.executable, "-m", "me2e_compress", *words],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": f"{package.parent}:{ROOT}", "HOME": str(tmp_path)},
    )
    assert done.returncode == 1
    # a busy machine is warned of where latency is measured, and shows progress
    said = done.stderr.splitlines()
    (line,) = (each for each in said if each.startswith("me2e-compress: "))
    assert "Traceback" not in done.stderr
    assert f"{module} is installed, but cannot be" in line
    assert reason in line
    (extra, *_) = (name for name, brings in MODULES.items() if module in brings)
    assert line.endswith(f"pip install --force-reinstall 'me2e-compress[{extra}]'")


def test_nothing_in_the_package_imports_torch() -> None:
    torch = re.compile(
        r"^\s*(?:import|from) torch\b|import_module\(.torch", re.MULTILINE
    )
    package = ROOT / "me2e_compress"
    files = [path for path in package.rglob("*.py") if torch.search(path.read_text())]
    assert files == []


@pytest.mark.parametrize("extra", MODULES)
def test_a_missing_extra_is_asked_for_before_work_starts(
    monkeypatch: pytest.MonkeyPatch, extra: str
) -> None:
    first = MODULES[extra][0]
    monkeypatch.setattr(
        "importlib.util.find_spec",
        lambda name: None if name == first else object(),
    )
    with pytest.raises(MissingExtraError) as caught:
        need_extra(extra, "this")
    assert str(caught.value) == (
        f"{first}, which this needs, is not installed: pip install"
        f" 'me2e-compress[{extra}]'"
    )


@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("No module named 'x'", name="me2e_compress.nothing"),
        ImportError("cannot import name 'a' from 'b'"),
        FileNotFoundError(2, "No such file", "frames"),
    ],
)
def test_what_has_nothing_to_do_with_an_extra_stays_as_it_is(error: Exception) -> None:
    assert explained(error) is error


def test_a_module_that_a_package_lacks_is_told_as_that_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As highway-env without pygame."""
    package = tmp_path / "onnxslim"
    package.mkdir()
    (package / "__init__.py").write_text("import not_to_be_had\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "onnxslim", raising=False)
    with pytest.raises(ImportError) as caught:
        __import__("onnxslim")
    told = explained(caught.value)
    assert isinstance(told, BrokenPackageError)
    assert told.args == ("onnxslim", "bench", "No module named 'not_to_be_had'")


def test_a_defect_of_ours_keeps_its_traceback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(standalone_mode: bool, prog_name: str) -> None:
        raise ModuleNotFoundError("No module named 'x'", name="me2e_compress.nothing")

    monkeypatch.setattr("me2e_compress.cli.app.app", broken)
    with pytest.raises(ModuleNotFoundError):
        main()


@pytest.mark.parametrize(
    "error",
    [
        MissingExtraError("ray", "ray"),
        BrokenPackageError("cv2", "highway", "libGL.so.1"),
        MissingPackageError("tensorrt"),
    ],
)
def test_errors_travel_between_processes(error: Exception) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (type(error), str(error))
