from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.workflows.prepare_int8 import PreparedGraph
from tests.nets import conv_attention


def test_what_is_prepared_leaves_the_message_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "m.onnx"
    graph.save(conv_attention(), path)

    ready = PreparedGraph.of(path, graph.load(path), "whole").model

    kinds = {type(each.const_value) for each in ready.graph.initializers.values()}
    assert kinds == {ir.Tensor}
