import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.graph import provenance
from me2e_compress.passes.onnx_ir_pass import OnnxIrPass
from me2e_compress.testing import check_pass
from tests.passes.small import apply, ops, read

IDENTITY = """
<ir_version: 9, opset_import: ["" : 17]>
g (float[2] x) => (float[2] y) { a = Identity(x) y = Relu(a) }
"""


def test_an_onnx_ir_pass_works_as_ours() -> None:
    model = read(IDENTITY)
    apply(OnnxIrPass(common.IdentityEliminationPass()), model)
    assert ops(model) == ["Relu"]


def test_what_changes_nothing_says_so() -> None:
    model = read(IDENTITY.replace("Identity", "Neg"))
    current = OnnxIrPass(common.IdentityEliminationPass())
    assert apply(current, model).changes == 0


def test_changed_nodes_name_the_pass() -> None:
    text = '<ir_version: 9, opset_import: ["" : 17]>'
    text += "g (float[2] x) => (float[2] y) { a = Softmax(x) y = Relu(a) }"
    current = OnnxIrPass(common.AddDefaultAttributesPass())

    softmax, relu = check_pass(current, ir.from_onnx_text(text)).model.graph

    pasts = [provenance.read(node) for node in (softmax, relu)]
    assert [past and past.passes for past in pasts] == [("onnx-ir-pass",), ()]
