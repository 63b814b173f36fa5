import onnx_ir as ir
import pytest

from me2e_compress.graph import provenance
from me2e_compress.manager import PassManager
from me2e_compress.passes.base import Context
from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.import_normalize import ImportNormalize


@pytest.mark.parametrize("known", [False, True], ids=["fresh", "with a past"])
@pytest.mark.parametrize(
    "body",
    [
        "a = Relu(x) y = Neg(a)",
        '["/backbone/n"] a = Relu(x) ["/backbone/n"] y = Neg(a)',
        '["/backbone/a"] a = Cast<to = 11>(x) ["/backbone/y"] y = Cast<to = 1>(a)',
        '["/backbone/a"] a = RotateTRT(x) ["/backbone/y"] y = Neg(a)',
    ],
    ids=["no names", "one name twice", "float64", "plugin"],
)
def test_a_graph_is_imported_as_exporters_leave_it(
    body: str, known: bool, context: Context
) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        f'm (float[1,8] x) => (float[1,8] y) {{ ["/backbone/b"] b = Abs(x) {body} }}'
    )
    for node in model.graph if known else ():
        provenance.stamp(node, provenance.Provenance("backbone", (str(node.name),)))
    report = PassManager((ImportNormalize(),)).run(model, context)
    assert report.steps[0].changes > 0


def test_a_graph_may_hold_text(context: Context) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 20]>\n'
        "m (string[2] x) => (string[2] y) {"
        ' unit = Constant<value_strings = ["m", "s"]>()'
        ' again = Constant<value_strings = ["m", "s"]>()'
        ' a = StringConcat(x, unit) ["/backbone/y"] y = StringConcat(a, again) }'
    )
    passes = (ImportNormalize(), FoldConstants(), EliminateRedundant())
    report = PassManager(passes).run(model, context)
    assert len(report.model.graph.initializers) == 1


def test_an_output_that_is_a_sequence_is_not_compared(context: Context) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[1,8] x) => (seq(float[1,4]) y) <int64[2] parts = {4, 4}> {"
        ' ["/backbone/a"] y = SplitToSequence<axis = 1>(x, parts) }'
    )
    (check,) = PassManager((ImportNormalize(),)).run(model, context).verifications
    assert check.skipped == "output y is no tensor: not compared"
