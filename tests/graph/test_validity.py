"""What ONNX's checker is asked, and what is let pass."""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import rewrite
from me2e_compress.graph.validity import refusal
from tests.support.plugins import exported


def test_an_output_without_a_shape_is_valid() -> None:
    assert refusal(exported(shapes=True, domain="custom_op")) is None


def test_a_plugin_of_the_default_domain_is_let_pass_where_that_is_asked() -> None:
    model = exported(shapes=True)
    assert "No Op registered for RotateTRT2" in str(refusal(model))
    assert refusal(model, plugins=True) is None
    assert {node.domain for node in model.graph} == {""}


def test_an_initializer_that_is_no_input_is_valid_whatever_the_ir_version() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 3, opset_import: ["" : 9]>'
        " m (float[2] x) => (float[2] y) { y = Add(x, x) }"
    )
    two = rewrite.add_constant(model.graph, np.ones(2, np.float32), "two")
    model.graph[0].replace_input_with(1, two)
    assert refusal(model) is None
