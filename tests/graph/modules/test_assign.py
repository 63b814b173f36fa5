import re

import onnx_ir as ir
import pytest

from me2e_compress.base.errors import ModuleMapError
from me2e_compress.graph.modules.assign import Assignment, assign
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.provenance import MODULE

MAP = ModuleMap.parse(
    '[modules.neck]\nrole = "feature"\noptional = ["neck"]\n'
    '[modules.det]\nrole = "prediction"\noptional = ["det"]\n'
    '[modules.plan]\nrole = "prediction"\noptional = ["plan"]',
    "three",
)


def read(signature: str, body: str) -> ir.Model:
    """Make a model; a weight written ``det__bias`` is called ``det.bias``."""
    model = ir.from_onnx_text(
        f'<ir_version: 8, opset_import: ["": 17]> g {signature} {{ {body} }}'
    )
    for weight in list(model.graph.initializers.values()):
        weight.name = str(weight.name).replace("__", ".")
    return model


def placed(result: Assignment) -> dict[str | None, tuple[str, str]]:
    return {
        node.outputs[0].name: (place.module, place.rule)
        for node, place in result.placements.items()
    }


ONE = "(float[2] x) => (float[2] y)"
RULES = {
    "a named parameter decides before the scope": (
        f"{ONE} <float[2] det__weight = {{1.0, 2.0}}>",
        '["/neck/Mul"] y = Mul(x, det__weight)',
        {"y": ("det", "parameter")},
    ),
    "a parameter reaches through arithmetic of constants": (
        "(float[1, 1] x) => (float[1, 1] y) <float[1, 1] det__w = {1.0}>",
        '["/neck/T"] t = Transpose(det__w) c = Cast<to: int = 1>(t)'
        ' ["/neck/M"] h = MatMul(x, c) ["/neck/R"] y = Relu(h)',
        {
            **dict.fromkeys(("t", "c", "h"), ("det", "parameter")),
            "y": ("neck", "scope"),
        },
    ),
    "an initializer that the exporter merged decides nothing": (
        f"{ONE} <float[2] det__bias = {{0.0, 0.0}}>",
        '["/det/Add"] a = Add(x, det__bias) ["/plan/Add"] y = Add(a, det__bias)',
        {"a": ("det", "scope"), "y": ("plan", "scope")},
    ),
    "glue that serves one module is of it": (
        ONE,
        '["/neck/Relu"] a = Relu(x) b = Neg(a) c = Abs(b) ["/det/Exp"] y = Exp(c)',
        dict.fromkeys("bc", ("det", "neighbour")),
    ),
    "glue that serves several is of the last that feeds it": (
        "(float[2] x) => (float[2] y, float[2] z)",
        '["/neck/Relu"] a = Relu(x) ["/det/Neg"] b = Neg(a) c = Add(b, a) d = Abs(c)'
        ' ["/plan/Exp"] y = Exp(d) ["/neck/Log"] z = Log(d)',
        dict.fromkeys("cd", ("det", "neighbour")),
    ),
    "glue that leaves the graph stays with its producer": (
        "(float[2] x) => (float[2] b, float[2] y)",
        '["/det/Relu"] a = Relu(x) b = Neg(a) ["/plan/Exp"] y = Exp(b)',
        {"b": ("det", "neighbour")},
    ),
    "a shared constant goes with its first consumer": (
        "(float[2] x) => (float[2] z)",
        ' k = Constant<value_floats = [1.0, 2.0]>() ["/neck/Relu"] a = Relu(x)'
        ' ["/det/Add"] y = Add(a, k) ["/plan/Add"] z = Add(y, k)',
        {"k": ("det", "neighbour")},
    ),
    "nodes in branches go by scope or with what holds them": (
        "(bool c, float[2] x) => (float[2] y)",
        '["/det/If"] y = If(c) <'
        'then_branch = t () => (float[2] a) { ["/plan/Relu"] a = Relu(x) },'
        " else_branch = e () => (float[2] b) { b = Neg(x) }>",
        {"a": ("plan", "scope"), "b": ("plan", "neighbour")},
    ),
    "what hangs on nothing goes with the node before it": (
        "(float[2] x, float[2] w) => (float[2] y, float[2] z)",
        '["/det/Relu"] y = Relu(x) z = Neg(w)',
        {"z": ("det", "neighbour")},
    ),
}


@pytest.mark.parametrize("rule", RULES)
def test_the_rule_that_applies_first_decides(rule: str) -> None:
    signature, body, expected = RULES[rule]
    places = placed(assign(read(signature, body), MAP))
    assert {name: places[name] for name in expected} == expected


def test_a_matmul_whose_weight_lost_its_name_goes_by_its_bias() -> None:
    model = read(
        "(float[1, 1] x) => (float[1, 1] y)"
        " <float[1, 1] weight = {1.0}, float[1] plan__bias = {1.0}>",
        '["/neck/MatMul"] h = MatMul(x, weight) ["/neck/Add"] y = Add(plan__bias, h)',
    )
    model.graph.initializers["weight"].name = "onnx::MatMul_123"
    assert placed(assign(model, MAP)) == dict.fromkeys("hy", ("plan", "parameter"))


@pytest.mark.parametrize(
    ("stamp", "place"), [("plan", ("plan", "stamp")), ("occ", ("det", "scope"))]
)
def test_stamps_decide_in_an_imported_graph(stamp: str, place: tuple[str, str]) -> None:
    model = read(ONE, '["/det/Relu"] y = Relu(x)')
    model.graph[0].metadata_props[MODULE] = stamp
    assert placed(assign(model, MAP)) == {"y": place}


def test_the_result_tells_nodes_and_rules() -> None:
    model = read(ONE, '["/neck/Relu"] a = Relu(x) ["/det/Neg"] b = Neg(a) y = Abs(b)')
    result = assign(model, MAP)
    assert result.rules() == {"scope": 2, "neighbour": 1}
    assert [node.outputs[0].name for node in result.nodes("det")] == ["b", "y"]
    assert result.module_of(model.graph[0]) == "neck"
    assert result.placements[model.graph[2]].rule == "neighbour"


MISSING = '[modules.det]\nrole = "prediction"\npatterns = ["det", "det.cls"]'


@pytest.mark.parametrize(
    ("chosen", "signature", "body", "words"),
    [
        (
            ModuleMap.parse(MISSING, "mine"),
            ONE,
            '["/det/reg/Relu"] y = Relu(x)',
            "map mine: pattern 'det.cls' of module det matches no parameter and no"
            " scope; there are det.reg",
        ),
        (
            MAP,
            f"{ONE} <float[2] trunk__w = {{1.0, 2.0}}>",
            '["/head/out/Mul"] y = Mul(x, trunk__w)',
            "map three: none of its patterns matches a parameter or a scope of this"
            " graph, which has head.out, trunk.w",
        ),
    ],
)
def test_a_map_of_another_graph_says_what_there_is(
    chosen: ModuleMap, signature: str, body: str, words: str
) -> None:
    with pytest.raises(ModuleMapError, match=re.escape(words)):
        assign(read(signature, body), chosen)


def test_a_required_pattern_may_match_and_lose() -> None:
    mine = ModuleMap.parse(
        '[modules.det]\nrole = "prediction"\npatterns = ["*.Head"]\n'
        '[modules.plan]\nrole = "prediction"\npatterns = ["Head.plan"]',
        "mine",
    )
    model = read(ONE, '["/Head/plan/Relu"] y = Relu(x)')
    assert placed(assign(model, mine)) == {"y": ("plan", "scope")}


def test_a_copy_of_an_equal_parameter_goes_by_its_own_name() -> None:
    """What the exporter writes where a norm of ``det`` has the numbers of ``neck``."""
    model = read(
        "(float[2] x) => (float[2] y) <float[2] neck__scale = {1.0, 1.0}>",
        '["Identity_7"] det__scale = Identity(neck__scale)'
        ' ["/neck/Mul"] n = Mul(x, neck__scale) ["/det/Mul"] y = Mul(n, det__scale)',
    )
    model.graph[0].outputs[0].name = "det.scale"
    assert placed(assign(model, MAP)) == {
        "det.scale": ("det", "parameter"),
        "n": ("neck", "parameter"),
        "y": ("det", "parameter"),
    }
