from collections.abc import Callable

import onnx_ir as ir
import pytest

from me2e_compress.graph.modules.assign import Item, assign, itemise
from tests.graph.modules.test_assign import MAP


def model() -> ir.Model:
    made = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17]>'
        "g (float[2] x) => (float[2] y)"
        " <float[2] neck_w = {1.0, 2.0}, float[2] shared = {3.0, 4.0},"
        "  int64[1] size = {2}, float[2] idle = {5.0, 6.0}> {"
        ' ["/neck/Mul"] a = Mul(x, neck_w)'
        ' ["/det/Add"] b = Add(a, shared) ["/det/Sub"] c = Sub(b, shared)'
        ' ["/det/Reshape"] y = Reshape(c, size) }'
    )
    made.graph.initializers["neck_w"].name = "neck.w"
    return made


def test_shared_weights_count_once_and_sizes_are_no_parameters() -> None:
    graph = model()
    result = itemise(graph, MAP, assign(graph, MAP).module_of, lambda node: 2)
    # nodes, parameters, bytes of weights, MACs, nodes of unknown MACs
    assert result == (
        *(Item("neck", 1, 2, 8, 2, 0), Item("det", 3, 2, 16, 6, 0)),
        Item("plan", 0, 0, 0, 0, 0),
    )


@pytest.mark.parametrize(
    ("macs", "expected"),
    [
        (lambda node: None if node.op_type == "Sub" else 1, [(1, 0), (2, 1), (0, 0)]),
        (lambda node: None, [(None, 1), (None, 3), (0, 0)]),
        (None, [(None, None)] * 3),
    ],
    ids=["a lower bound", "none known is not zero", "nobody counts"],
)
def test_macs_that_are_not_known(
    macs: Callable[[ir.Node], int | None] | None,
    expected: list[tuple[int | None, int | None]],
) -> None:
    graph = model()
    items = itemise(graph, MAP, assign(graph, MAP).module_of, macs)
    assert [(each.macs, each.unknown_macs_nodes) for each in items] == expected


def test_int8_weights_are_parameters() -> None:
    graph = model()
    weight = graph.graph.initializers["neck.w"]
    weight.const_value = ir.tensor([1, 2], dtype=ir.DataType.INT8)
    neck = itemise(graph, MAP, assign(graph, MAP).module_of)[0]
    assert (neck.parameters, neck.weight_bytes) == (2, 2)
