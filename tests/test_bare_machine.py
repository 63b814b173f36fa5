"""What can be imported, and what --help shows, where an extra is not installed."""

import json
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

from me2e_compress.cli.app import COMMANDS
from me2e_compress.extras import MODULES

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: Mapping[str, list[str]] = PROJECT["optional-dependencies"]
TOOLS = ("bench", "docs", "test")
"""Extras whose own packages no module of ours imports: they are blocked together."""
PACKAGE = "me2e_compress"
ALL, EVERY_TOOL = "all at once", "+".join(TOOLS)

WORLD = (
    "evaluators.highway.blind",
    "evaluators.highway.driven_frames",
    "evaluators.highway.expert",
    "evaluators.highway.generate",
    "evaluators.highway.observe",
    "evaluators.highway.render",
    "evaluators.highway.runner",
    "simulator.cameras",
    "simulator.pictures",
    "study",
    "evaluators.highway.controller",
    "evaluators.highway.episode_recorder",
    "simulator.privileged",
    "simulator.scenarios",
    "simulator.traffic",
    "simulator.world",
    "workflows.latency_figure",
)
KERNELS = (
    "operators.kernels.attention_call",
    "operators.kernels.attention_kernel",
    "operators.kernels.call_context",
    "operators.kernels.custom_ops",
    "operators.kernels.deformable_kernel",
    "operators.kernels.exponential",
    "operators.kernels.intrinsics",
    "operators.kernels.machine_code",
    "operators.kernels.matrix_tile",
    "operators.kernels.online_softmax",
    "operators.kernels.raw_attention_kernel",
    "operators.kernels.sampling",
    "operators.kernels.vectors",
    "operators.kernels.weighted_rows",
    "operators.kernels.winograd_blocks",
    "operators.kernels.winograd_kernel",
    "operators.kernels.winograd_transforms",
)
ROOMS: Mapping[str, tuple[str, ...]] = {
    "highway": WORLD,
    "fast": KERNELS,
    "trt-check": ("targets.tensorrt.rtx.rtx_main",),
}
"""Modules, or rooms with them, that cannot be imported without an extra."""


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
    """What fails without each extra: modules, and `--help` of commands."""
    cases = tmp_path_factory.mktemp("bare") / "cases.json"
    cases.write_text(json.dumps(CASES))
    script = Path(__file__).with_name("blocked_imports.py")
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


bare = pytest.mark.xdist_group("bare")


def rooms_without(case: str) -> set[str]:
    """Return the rooms that may fail in a case."""
    cases = ROOMS if case == ALL else [case]
    return {room for extra in cases for room in ROOMS.get(extra, ())}


@bare
@pytest.mark.parametrize("case", CASES)
def test_modules_fail_without_an_extra_in_its_rooms_and_nowhere_else(
    without: dict[str, Any], case: str
) -> None:
    rooms, failing = rooms_without(case), without[case]["modules"]
    homes = {
        name: {room for room in rooms if f"{name}.".startswith(f"{PACKAGE}.{room}.")}
        for name in failing
    }
    assert {name: failing[name] for name, home in homes.items() if not home} == {}
    assert rooms == set().union(*homes.values())


@bare
@pytest.mark.parametrize("case", CASES)
def test_help_of_every_command_shows_its_options_without_an_extra(
    without: dict[str, Any], case: str
) -> None:
    silent = {
        command: said
        for command, (code, said) in without[case]["help"].items()
        if code != 0 or ("--json" not in said)
    }
    assert silent == {}
    assert without[case]["help"].keys() == COMMANDS.keys()


@bare
@pytest.mark.parametrize("case", CASES)
def test_a_public_name_without_its_extra_says_what_to_install(
    without: dict[str, Any], case: str
) -> None:
    lacking = without[case]["names"]
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
