"""Graphs as exporters write them go through `exact` and answer the same."""

from pathlib import Path

import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager, Report, recipe
from me2e_compress.passes import Context
from tests.support.nets import parsed


def exact(model: ir.Model) -> Report:
    """Run the recipe; the manager proves that the outputs are the same."""
    return PassManager(recipe.load("exact")).run(model, Context(ModuleMap.whole()))


def settled(text: str) -> list[str]:
    """Run `exact`, which must leave nothing to do; list what is left."""
    report = exact(parsed(text))
    again = exact(report.model)
    assert not any(step.changes for step in again.steps)
    return [node.op_type for node in again.model.graph]


def test_a_constant_in_the_type_of_a_value_is_folded() -> None:
    assert settled(
        """g (float[1,1,8,8] x) => (float[1,2,8,8] y)
        <float[2,1,1,1] w = {1,2}, float[2] s = {1,2}, float[2] m = {0,1}> {
            zero = Constant <value_float = 0.0> ()
            like = CastLike (zero, x)
            two = Constant <value_ints = [2]> ()
            b = Expand (like, two)
            c = Conv <kernel_shape = [1,1]> (x, w, b)
            y = BatchNormalization (c, s, m, m, s)
        }"""
    ) == ["Conv"]


TILE = """g (float[1,3] x, bool c) => (float[2,3] y) {
    repeats = Constant <value_ints = [2,1]> () zero = Constant <value_int = 0> ()
    shape = Shape (x) rank = Size (shape) two = Constant <value_int = 2> ()
    d = Sub (two, rank) known = Greater (d, zero)
    r = If (%s) <
        then_branch = t () => (int64[3] s) {
            one = Constant <value_ints = [1]> () n = Reshape (d, one)
            e = Expand (one, n) s = Concat <axis = 0> (e, repeats)
        },
        else_branch = f () => (int64[2] q) { q = Identity (repeats) }
    >
    y = Tile (x, r)
}"""


@pytest.mark.parametrize(("condition", "left"), [("known", "Tile"), ("c", "If")])
def test_branches_may_declare_shapes_that_differ(condition: str, left: str) -> None:
    assert settled(TILE % condition)[0] == left


def test_a_branch_behind_a_branch_is_taken_too() -> None:
    """`if x.size(1) == 1: x = x.squeeze(1)`, and back, three times."""
    lines, source = [], "x"
    for n in range(6):
        axes, op = ("[1]", "Squeeze") if n % 2 == 0 else ("[1]", "Unsqueeze")
        rank = 3 if op == "Squeeze" else 2
        lines.append(
            f"""s{n} = Shape ({source}) n{n} = Size (s{n})
            k{n} = Constant <value_int = {rank}> () e{n} = Equal (n{n}, k{n})
            a{n} = Constant <value_ints = {axes}> ()
            v{n} = If (e{n}) <then_branch = t () => (float t{n}) {{
                t{n} = {op} ({source}, a{n}) }}, else_branch = f () => (float f{n}) {{
                f{n} = Identity ({source}) }}>"""
        )
        source = f"v{n}"
    for node in (
        model := parsed(f"""g (float[4,1,3] x) => (float[4,1,3] y) {{
        {" ".join(lines)} y = Relu ({source}) }}""")
    ).graph:
        if node.op_type == "If":
            node.outputs[0].shape = None
            for name in ("then_branch", "else_branch"):
                node.attributes[name].as_graph().outputs[0].shape = None
    assert "If" not in [node.op_type for node in exact(model).model.graph]


def test_a_function_may_import_its_own_domain() -> None:
    assert settled(
        """<ir_version: 9, opset_import: ["" : 17, "my" : 1]>
        g (float[2,8] x) => (float[2,8] y) { t = my.Bend (x) y = my.Bend (t) }
        <domain: "my", opset_import: ["" : 17, "my" : 1]>
        Bend (a) => (b) { s = Mul (a, a) b = Add (s, a) }"""
    ) == ["Bend", "Bend"]


def test_the_standard_domain_may_have_its_name(tmp_path: Path) -> None:
    text = """<ir_version: 8, opset_import: ["ai.onnx" : 17]>
    g (float[2,8] x) => (float[2,8] y) {
        r = ai.onnx.Relu (x) y = ai.onnx.Softmax (r)
    }"""
    model = onnx.parser.parse_model(text)
    assert {node.domain for node in model.graph.node} == {"ai.onnx"}
    onnx.save(model, tmp_path / "m.onnx")

    result = exact(graph.load(tmp_path / "m.onnx"))

    assert [node.domain for node in result.model.graph] == ["", ""]
    assert result.model.opset_imports == {"": 17}
