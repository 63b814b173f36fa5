"""The package and the example, installed from wheels into a folder of their own."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

from tests.docs.pages import EXAMPLE, ROOT

MODEL = """
<ir_version: 9, opset_import: ["" : 17]>
small (float[1,3,8,8] image) => (float[1,4] plan)
<int64[2] flat = {1, 256}> {
    ["/backbone/Conv"] a = Conv<pads = [1, 1, 1, 1]>(image, w)
    ["/backbone/Relu"] b = Relu(a)
    ["/plan_head/Reshape"] c = Reshape(b, flat)
    ["/plan_head/MatMul"] plan = MatMul(c, p)
}
"""


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that pip installed both wheels into."""
    wheels, folder = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    alone = ["--no-deps", "--no-build-isolation"]
    for source in (ROOT, EXAMPLE):
        copy = _copy(source, tmp_path_factory.mktemp("source"))
        run([*pip, "wheel", *alone, "-w", str(wheels), str(copy)])
    found = sorted(map(str, wheels.glob("*.whl")))
    run([*pip, "install", "--no-deps", "--target", str(folder), *found])
    return folder


def write_model(path: Path) -> None:
    """Write the model that pages take for granted."""
    model, generator = onnx.parser.parse_model(MODEL), np.random.default_rng(0)
    for name, shape in (("w", (4, 3, 3, 3)), ("p", (256, 4))):
        array = generator.standard_normal(shape, np.float32)
        model.graph.initializer.append(onnx.numpy_helper.from_array(array, name))
    onnx.save(model, path)


def run(
    command: list[str], folder: Path | None = None, site: Path | None = None
) -> str:
    """Run a command, with the installed packages alone if a site is given."""
    environment = dict(os.environ)
    environment.pop("PYTHONPATH", None)
    if site is not None:
        environment["PYTHONPATH"] = str(site)
        environment["PATH"] = f"{site / 'bin'}{os.pathsep}{environment['PATH']}"
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def _copy(source: Path, folder: Path) -> Path:
    """Copy what is built: building in place would leave folders in the checkout."""
    ignored = shutil.ignore_patterns(".*", "build", "out", "tests", "*.egg-info")
    shutil.copytree(source, folder / "it", ignore=ignored, symlinks=True)
    return folder / "it"
