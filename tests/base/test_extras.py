"""What is there, and what is said, where an extra is not installed or only half."""

import json
import pickle
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from me2e_compress.base.errors import (
    BrokenPackageError,
    MissingExtraError,
)
from me2e_compress.base.extras import MODULES, require_extra, with_install_hint
from me2e_compress.cli import main
from me2e_compress.cli.app import COMMANDS

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: Mapping[str, list[str]] = PROJECT["optional-dependencies"]
TOOLS = ("bench", "docs", "test")
"""Extras whose own packages no module of ours imports: they are blocked together."""
ALL, EVERY_TOOL = "all at once", "+".join(TOOLS)

ROOMS: Mapping[str, tuple[str, ...]] = {
    "highway": ("evaluators.highway", "simulator", "study"),
    "fast": ("operators.kernels",),
    "openvino": ("operators.kernels.openvino_ops",),
    "trt-check": ("targets.tensorrt.rtx_main",),
}
"""Rooms, or modules, in which something cannot be imported without an extra."""


def distributions(wanted: Iterator[Requirement]) -> set[str]:
    """Return the packages that some requirements bring, with all that those need."""
    found, ahead = set[tuple[str, str]](), list(wanted)
    while ahead:
        each = ahead.pop()
        name = canonicalize_name(each.name)
        for extra in ("", *each.extras):
            if (name, extra) in found:
                continue
            found.add((name, extra))
            try:
                needs = requires(name) or []
            except PackageNotFoundError:
                continue
            ahead += [
                need
                for need in map(Requirement, needs)
                if need.marker is None or need.marker.evaluate({"extra": extra})
            ]
    return {name for name, _ in found}


def modules_of(packages: set[str]) -> set[str]:
    """Return what packages are imported as; of one that is not there, its name."""
    homes = packages_distributions()
    known = {canonicalize_name(name) for names in homes.values() for name in names}
    imported = {
        module
        for module, names in homes.items()
        if packages & {canonicalize_name(name) for name in names}
    }
    return imported | {name.replace("-", "_") for name in packages - known}


def blocked() -> dict[str, list[str]]:
    """Return the modules that are missing without each extra, and without any.

    Without one it is what the extra names, and what none of the others needs.
    """
    needs = {extra: list(map(Requirement, listed)) for extra, listed in EXTRAS.items()}
    base = distributions(map(Requirement, PROJECT["dependencies"]))
    closed = {extra: distributions(iter(listed)) for extra, listed in needs.items()}
    gone = dict[str, list[str]]()
    for extra in [each for each in needs if each not in TOOLS]:
        named = {canonicalize_name(each.name) for each in needs[extra]}
        others = base.union(*(closed[each] for each in closed if each != extra))
        gone[extra] = sorted(modules_of((closed[extra] - others) | (named - base)))
    used = base.union(*(closed[each] for each in gone))
    tools = set[str]().union(*(closed[each] for each in TOOLS))
    gone[EVERY_TOOL] = sorted(modules_of(tools - used))
    gone[ALL] = sorted(modules_of(set[str]().union(*closed.values()) - base))
    return gone


CASES = blocked()


@pytest.fixture(scope="module")
def without(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What fails without each extra: modules, public names, `--help` of commands."""
    cases = tmp_path_factory.mktemp("bare") / "cases.json"
    cases.write_text(json.dumps(CASES))
    script = ROOT / "tests" / "support" / "blocked_imports.py"
    done = subprocess.run(
        [sys.executable, script, cases],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "COLUMNS": "80"},
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.xdist_group("bare")
@pytest.mark.parametrize("case", CASES)
def test_without_an_extra_its_rooms_fail_and_nothing_else(
    without: dict[str, Any], case: str
) -> None:
    failing, helps, lacking = (without[case][k] for k in ("modules", "help", "names"))
    may = {room for extra in ROOMS if case in (extra, ALL) for room in ROOMS[extra]}
    homes = {
        name: {room for room in may if f"{name}.".startswith(f"me2e_compress.{room}.")}
        for name in failing
    }
    assert {name: failing[name] for name, home in homes.items() if not home} == {}
    assert may == set().union(*homes.values())
    # every command shows its options
    assert helps.keys() == COMMANDS.keys()
    assert {n: s for n, (code, s) in helps.items() if code or "--json" not in s} == {}
    # a public name says what to install
    assert all(each.startswith("MissingExtraError: ") for each in lacking.values())
    assert bool(lacking) == (case in ("highway", ALL))


def test_modules_of_extras_are_what_the_project_says() -> None:
    brought = {
        extra: modules_of({canonicalize_name(Requirement(each).name) for each in needs})
        for extra, needs in EXTRAS.items()
    }
    strangers = {
        (extra, module)
        for extra, modules in MODULES.items()
        for module in modules
        if module not in brought[extra] and module not in CASES.get(extra, ())
    }
    assert strangers == set()
    assert MODULES.keys() == EXTRAS.keys() - {"docs", "test"}


def commands() -> Mapping[str, tuple[str, ...]]:
    """Return words that need an extra, by the module of it that is broken."""
    return {
        "highway_env": ("evaluate", "highway", "--routes", "1", "-o", "out"),
        "cv2": ("evaluate", "highway", "--routes", "1", "-o", "out"),
        "jinja2": ("study", "smoke", "-o", "out"),
        "ray": (
            *("evaluate", "highway", "--routes", "1", "--engine", "ray"),
            "-o",
            "o",
        ),
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
        "importlib.util.find_spec", lambda name: None if name == first else object()
    )
    with pytest.raises(MissingExtraError) as caught:
        require_extra(extra, "this")
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
    assert with_install_hint(error) is error


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
    told = with_install_hint(caught.value)
    assert isinstance(told, BrokenPackageError)
    assert told.args == ("onnxslim", "bench", "No module named 'not_to_be_had'")


def test_a_defect_of_ours_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ModuleNotFoundError("No module named 'x'", name="me2e_compress.nothing")

    monkeypatch.setattr("me2e_compress.cli._commands", broken)
    with pytest.raises(ModuleNotFoundError):
        main()


@pytest.mark.parametrize(
    "error",
    [
        MissingExtraError("ray", "ray"),
        BrokenPackageError("cv2", "highway", "libGL.so.1"),
    ],
)
def test_errors_travel_between_processes(error: Exception) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (type(error), str(error))
