"""onnxruntime divides the least integer by -1 while it opens this graph, and dies."""

from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from tests.cli.conftest import Command, write_frames

DEADLY = """
<ir_version: 9, opset_import: ["" : 17]>
deadly (float[1,4] camera) => (float[1,4] plan, int32[1] count)
<int32[1] least = {-2147483648}, int32[1] minus = {-1}> {
    plan = Relu(camera)
    count = Div(least, minus)
}
"""


@pytest.mark.opens_apart
def test_a_graph_that_kills_onnxruntime_is_one_line(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    graph.save(ir.from_onnx_text(DEADLY), tmp_path / "deadly.onnx")
    write_frames(tmp_path / "frames", camera=np.zeros((1, 4), np.float32))

    assert command("compare", "deadly.onnx", "deadly.onnx", "frames") == 1

    said = capsys.readouterr().err.splitlines()[-1]
    assert said == (
        "me2e-compress: deadly.onnx: onnxruntime dies of it (SIGFPE) at step open"
    )
