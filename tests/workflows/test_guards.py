"""What is refused from Python as it is on the command line, before any work."""

from collections.abc import Callable
from pathlib import Path

import onnx_ir as ir
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.errors import (
    GraphError,
    Me2eError,
    PreconditionError,
    RecipeError,
)

SEARCH = me2e.SearchOptions(max_mb=1.0)
WRITERS: dict[str, Callable[[str], object]] = {
    "compress": lambda out: me2e.compress("dense.onnx", out, "exact"),
    "calibrate": lambda out: me2e.calibrate("dense.onnx", "frames", out),
    "plan": lambda out: me2e.plan("dense.onnx", out),
    "profile": lambda out: me2e.profile("dense.onnx", "frames", out),
    "sensitivity": lambda out: me2e.measure_sensitivity("dense.onnx", "frames", out),
    "search": lambda out: me2e.search("dense.onnx", "frames", out, SEARCH),
    "evaluate": lambda out: me2e.evaluate("dense.onnx", out),
}


@pytest.mark.parametrize("name", WRITERS)
def test_no_workflow_writes_over_its_input(
    dense: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(dense)
    before = (dense / "dense.onnx").read_bytes()

    with pytest.raises(GraphError, match=r"^dense\.onnx is (the input|a file)"):
        WRITERS[name]("dense.onnx")
    assert (dense / "dense.onnx").read_bytes() == before


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: me2e.CompressOptions(verify_frames=-1), RecipeError, "-frames is -1"),
        (lambda: me2e.CalibrateOptions(threads=-2), RecipeError, "--threads is -2"),
        (lambda: me2e.CalibrateOptions(method="max"), RecipeError, "method 'max'"),
        (lambda: me2e.SearchOptions(), RecipeError, "give a budget"),
        (lambda: me2e.SearchOptions(max_ms=float("nan")), RecipeError, "is nan"),
        (lambda: me2e.SensitivityOptions(limit=-1.0), RecipeError, "--limit is -1"),
        (lambda: me2e.ProfileOptions(samples=10**20), RecipeError, "--samples is 1"),
        (lambda: me2e.ProfileOptions(warm_up=10**20), RecipeError, "--warm-up is 1"),
        (lambda: me2e.ProfileOptions(threads=10**9), RecipeError, "1,024 at most"),
        (lambda: me2e.CalibrateOptions(threads=10**9), RecipeError, "1,024 at most"),
        (lambda: me2e.LintOptions("onnxruntime", trt_check=True), RecipeError, "trt"),
    ],
)
def test_options_are_checked_once_when_they_are_made(
    make: Callable[[], object], error: type[Me2eError], message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_refused_graph_is_a_result_and_an_error_once_it_is_checked(
    tmp_path: Path,
) -> None:
    text = (
        '<ir_version: 9, opset_import: ["" : 17, "own" : 1]>'
        "m (float[2] x) => (float[2] y) { y = own.Twist(x) }"
    )
    graph.save(ir.from_onnx_text(text), tmp_path / "twist.onnx")

    found = me2e.lint(tmp_path / "twist.onnx")

    assert [each.rule for each in found.findings] == ["plugin"]
    with pytest.raises(PreconditionError, match="tensorrt refuses it, 1 error;"):
        found.check()
