"""The line of *your own model* that writes metadata, run as it stands there."""

import subprocess
import sys
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.runtime.session import Session
from tests.docs.pages import ROOT, blocks

MINE = """
<ir_version: 9, opset_import: ["" : 17]>
mine (float[1,4] img, float[1,4] prev_bev) => (float[1,4] bev_embed)
{ bev_embed = Add(img, prev_bev) }
"""


def test_the_line_that_names_the_state_works(tmp_path: Path) -> None:
    graph.save(ir.from_onnx_text(MINE), tmp_path / "M.onnx")
    (line,) = blocks(ROOT / "docs" / "your-model.md", "")
    assert line.text.startswith("python -c ")
    run = line.text.replace("python", sys.executable, 1)

    for _ in range(2):  # a line that is copied is run again
        subprocess.run(["bash", "-c", run], cwd=tmp_path, check=True)

    assert Session(tmp_path / "M.onnx").recurrent == {"prev_bev": "bev_embed"}
