"""A refusal of onnxruntime is one line of ours: it says nothing of its own."""

from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.rewrite import add_constant
from me2e_compress.runtime.session import Session


def test_a_graph_that_is_refused_twice_makes_no_warning(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "g (float[1,4] x, float[3,3] w) => (float[1,3] y) { y = MatMul(x, w) }"
    )
    (_, weight), product = model.graph.inputs, model.graph[0]
    model.graph.inputs.remove(weight)
    known = add_constant(model.graph, np.ones((3, 3), np.float32), "known")
    product.replace_input_with(1, known)
    graph.save(model, tmp_path / "m.onnx")

    with pytest.raises(GraphError, match="onnxruntime cannot run this graph"):
        Session(tmp_path / "m.onnx")

    assert capfd.readouterr() == ("", "")
