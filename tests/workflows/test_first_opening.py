"""Opened in a process of its own, once."""

import subprocess
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.errors import GraphError
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Array
from me2e_compress.workflows import first_opening
from me2e_compress.workflows.first_opening import try_apart, try_file
from me2e_compress.workflows.listener import SILENT
from tests.stacks import write_stack

pytestmark = pytest.mark.opens_apart


def test_a_graph_that_survived_is_not_tried_again(
    driver: ir.Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera: dict[str, Array] = {"camera": np.zeros((1, 4), np.float32)}
    camera["file"] = np.zeros(1)  # a name that numpy's savez takes for its own
    assert try_apart(driver, "driver", feeds=camera, memory=tmp_path) > 0
    (verdict,) = tmp_path.iterdir()
    tried: list[object] = []

    def noted(script: Path, words: list[str]) -> object:
        tried.append(script)
        return run_script(script, words)

    monkeypatch.setattr(first_opening, "run_script", noted)

    assert try_apart(driver, "driver", memory=tmp_path) == 0.0
    assert tried == []

    verdict.write_text("{" * 9)  # no verdict at all
    assert try_apart(driver, "driver", feeds=camera, memory=tmp_path) > 0
    assert len(tried) == 1


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (-9, "was killed (out of memory?) at step run"),
        (-11, "dies of it (SIGSEGV) at step run"),
        (3221225477, "dies of it (exit code 3221225477) at step run"),
    ],
)
def test_how_it_died(
    driver: ir.Model,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    code: int,
    said: str,
) -> None:
    dead = subprocess.CompletedProcess([], code, "open\nrun\n", "")
    monkeypatch.setattr(first_opening, "run_script", lambda script, words: dead)

    with pytest.raises(GraphError) as caught:
        try_apart(driver, "driver.onnx", memory=tmp_path)

    assert str(caught.value) == f"driver.onnx: onnxruntime {said}"
    assert list(tmp_path.iterdir()) == []


def test_a_crash_of_a_stack_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(*_: object, **__: object) -> None:
        raise GraphError("stack.toml: onnxruntime dies of it")

    monkeypatch.setattr(first_opening, "try_apart", dies)

    with pytest.raises(GraphError, match="dies of it"):
        try_file(write_stack(tmp_path), SILENT)
