import onnx_ir as ir

from me2e_compress.graph.modules import Item, ModuleMap, assign, itemise

MAP = ModuleMap.parse(
    '[modules.neck]\nrole = "feature"\noptional = ["neck"]\n'
    '[modules.det]\nrole = "prediction"\noptional = ["det"]\n'
    '[modules.occ]\nrole = "prediction"\noptional = ["occ"]',
    "three",
)


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


def two_each(node: ir.Node) -> int | None:
    return 2


def test_shared_weights_count_once_and_sizes_are_no_parameters() -> None:
    graph = model()
    found = itemise(graph, MAP, assign(graph, MAP).module_of, two_each)
    assert found == (
        Item(
            "neck", nodes=1, parameters=2, weight_bytes=8, macs=2, unknown_macs_nodes=0
        ),
        Item(
            "det", nodes=3, parameters=2, weight_bytes=16, macs=6, unknown_macs_nodes=0
        ),
        Item(
            "occ", nodes=0, parameters=0, weight_bytes=0, macs=0, unknown_macs_nodes=0
        ),
    )


def cost(item: Item) -> tuple[int | None, int | None]:
    return item.macs, item.unknown_macs_nodes


def test_unknown_macs_leave_a_lower_bound_and_say_how_many_nodes_it_lacks() -> None:
    graph = model()
    placed = assign(graph, MAP).module_of

    def unknown_sub(node: ir.Node) -> int | None:
        return None if node.op_type == "Sub" else 1

    found = itemise(graph, MAP, placed, unknown_sub)
    assert list(map(cost, found)) == [(1, 0), (2, 1), (0, 0)]


def test_macs_of_which_none_is_known_are_not_zero() -> None:
    graph = model()
    placed = assign(graph, MAP).module_of

    found = itemise(graph, MAP, placed, lambda node: None)
    assert list(map(cost, found)) == [(None, 1), (None, 3), (0, 0)]


def test_macs_that_nobody_counts_are_not_measured() -> None:
    graph = model()

    found = itemise(graph, MAP, assign(graph, MAP).module_of)
    assert list(map(cost, found)) == [(None, None)] * 3


def test_int8_weights_are_parameters() -> None:
    graph = model()
    weight = graph.graph.initializers["neck.w"]
    weight.const_value = ir.tensor([1, 2], dtype=ir.DataType.INT8)
    neck = itemise(graph, MAP, assign(graph, MAP).module_of)[0]
    assert (neck.parameters, neck.weight_bytes) == (2, 2)
