"""A graph in float64: what cannot run it says so, what makes it float32 does, too."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.command import Cli, write_frames
from tests.support.nets import save_text

SAMPLED = """
    <ir_version: 9, opset_import: ["" : 16]>
    m (float[1,2,3,3] x, float[1,3,3,2] g) => (float[1,2,3,3] y)
    <double h = {0.5}, float[3,3] w = {1,0,0,0,1,0,0,0,1}> {
        a = Cast<to=11>(x) b = Cast<to=11>(g)
        ["/neck/GridSample"] s = GridSample(a, b)
        t = Mul(s, h)
        o = Cast<to=1>(t)
        y = MatMul(o, w)
    }
"""
NO_KERNEL = (
    "onnxruntime has no kernel for GridSample of float64 (node '/neck/GridSample'):"
    " import-normalize makes it float32 (compress -r exact)"
)


@pytest.fixture(autouse=True)
def double(tmp_path: Path) -> None:
    save_text(tmp_path / "double.onnx", SAMPLED)
    draws = np.random.default_rng(0)
    x = draws.normal(size=(1, 2, 3, 3)).astype(np.float32)
    g = draws.uniform(-1, 0, size=(1, 3, 3, 2)).astype(np.float32)
    write_frames(tmp_path / "frames", x=x, g=g)


def test_its_float32_form_is_what_is_measured_and_compared_and_the_verdict_says_so(
    cli: Cli, tmp_path: Path
) -> None:
    paper = '[[pass]]\nname = "quantize-int8"\nrules = "paper"\n'
    (tmp_path / "paper.toml").write_text(paper)
    cli.done("calibrate double.onnx frames -o ranges.json -r paper.toml")
    found = cli.document("compress double.onnx -r exact -o out.onnx --frames frames")

    same, told = found["verdict"][:2]
    assert same.startswith("every output is the same")
    assert told == (
        "not proven: import-normalize, float64 became float32: 4 nodes:"
        f" {NO_KERNEL}; what is proven begins with what it made"
    )
    cli.done("compare out.onnx out.onnx frames")


def test_float64_that_runs_is_proven_against_itself(cli: Cli, tmp_path: Path) -> None:
    text = SAMPLED.replace("GridSample(a, b)", "Mul(a, h)")
    save_text(tmp_path / "double.onnx", text)

    found = cli.document("compress double.onnx -r exact -o out.onnx --frames frames")

    (check,) = found["verifications"]
    assert check["passes"][0] == "import-normalize"
    assert not any("not proven" in line for line in found["verdict"])


def test_another_provider_is_not_held_to_the_kernels_of_the_cpu(cli: Cli) -> None:
    said = cli.refused("lint double.onnx --target onnxruntime --provider cuda")

    assert "cuda" in said
    assert "kernel" not in said
