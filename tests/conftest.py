import gc
from collections.abc import Iterator
from tempfile import TemporaryDirectory
from typing import cast

import onnx_ir as ir
import pytest

from me2e_compress.commands import checks
from me2e_compress.driving.policies import POLICIES
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.passes.base import Context
from tests.support import profiles
from tests.support.command import cli, command, dense, files
from tests.support.in_process import here, short
from tests.support.nets import DRIVER, DRIVER_MAP
from tests.support.stand_in import weights

__all__ = ["cli", "command", "dense", "files", "here", "short", "weights"]

profiles.register()
# the cheapest driver, which tests alone know by this name
BLIND = {"blind": "models.driver.expert.blind:BlindDriver"}
cast("dict[str, str]", POLICIES.builtin).update(BLIND)


def pytest_configure(config: pytest.Config) -> None:
    """Let what is compiled or remembered lie in a folder of this run, not the user's.

    Before collection, since a test that asks whether kernels compile is skipped by it;
    workers get the folder from the process that starts them.
    """
    if hasattr(config, "workerinput"):
        return
    folder, patch = TemporaryDirectory(prefix="me2e-tests-"), pytest.MonkeyPatch()
    patch.setenv("XDG_CACHE_HOME", folder.name)
    config.add_cleanup(patch.undo)
    config.add_cleanup(folder.cleanup)


def pytest_collection() -> None:
    """Look for no garbage while modules are imported and tests are made of them."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Leave what is there now out of every later search: it stays to the end."""
    gc.enable()
    gc.freeze()


@pytest.fixture(autouse=True)
def opened_before(request: pytest.FixtureRequest) -> Iterator[None]:
    """No graph is opened apart first, but in the tests of just that."""
    if request.node.get_closest_marker("opens_apart"):
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checks, "CPU", None)  # no provider is that one
        yield


@pytest.fixture
def driver() -> ir.Model:
    """A driving model in three nodes."""
    return ir.from_onnx_text(DRIVER)


@pytest.fixture
def driver_map() -> ModuleMap:
    return ModuleMap.parse(DRIVER_MAP, "driver")


@pytest.fixture
def context(driver_map: ModuleMap) -> Context:
    return Context(driver_map)
