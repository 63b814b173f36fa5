"""Which operators of which types onnxruntime's CPU runs, as it says itself."""

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.runtime.kernel_types import without_kernel
from me2e_compress.runtime.session import Session
from tests.passes import onnx_cases

SAMPLED = """
    <ir_version: 9, opset_import: ["" : 16]>
    m (%(kind)s[1,1,2,2] x, float[1,1,1,2] g) => (%(kind)s[1,1,1,1] y) {
        a = Cast<to=11>(x) b = Cast<to=11>(g)
        ["sampler"] s = GridSample(a, b)
        y = Cast<to=%(to)d>(s)
    }
"""


@pytest.mark.parametrize(
    ("kind", "to", "remedy"),
    [
        ("float", 1, r": import-normalize makes it float32 \(compress -r exact\)$"),
        ("double", 11, "'sampler'.$"),  # import-normalize keeps inputs and outputs
    ],
)
def test_a_session_says_what_has_no_kernel(kind: str, to: int, remedy: str) -> None:
    model = ir.from_onnx_text(SAMPLED % {"kind": kind, "to": to})

    said = r"^onnxruntime has no kernel for GridSample of float64 \(node 'sampler'\)"
    with pytest.raises(GraphError, match=said) as refused:
        Session(model)

    assert refused.match(remedy)


@pytest.mark.slow
def test_nothing_that_opens_is_said_to_have_no_kernel() -> None:
    """Every model of ONNX's own suite: 1,500 open, 25 of 39 others are named."""
    opened = named = 0
    for case in onnx_cases.load():
        model = ir.from_proto(case.model)
        graph.infer_shapes(model)
        said = [what for _, what in without_kernel(model)]
        try:
            Session(model)
        except (GraphError, TypeError):
            named += bool(said)
        else:
            assert said == [], case.name
            opened += 1
    assert opened > 1_000
    assert named >= 10
