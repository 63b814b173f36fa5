"""The user's exceptions to a plan."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress.base.errors import RecipeError
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.quantization.decision import Overrides, QuantPlan, QuantScheme
from me2e_compress.quantization.plan import make_plan
from tests.support.nets import FULL, MODULES, PAPER, conv_attention


def planned(text: str, scheme: str = "full") -> QuantPlan:
    overrides = Overrides.parse(text)
    named = QuantScheme.named(scheme, MODULES)
    return make_plan(conv_attention(), named, PAPER, overrides=overrides)


def chosen(plan: QuantPlan) -> list[str]:
    return [each.node for each in plan.chosen]


@pytest.mark.parametrize(
    "matcher",
    ['nodes = "/head/?[KV]"', 'module = "head"\nop = "MatMul"\nnodes = "/head/[QA]*"'],
)
def test_nodes_are_kept_in_float_by_glob_module_and_operator(matcher: str) -> None:
    plan = planned(f'[[override]]\n{matcher}\ndtype = "float"\nreason = "loses 3 dB"')

    assert chosen(plan) == ["/backbone/Conv", "/head/Linear"]
    said = [each for each in plan.decisions if each.rule == "override"]
    assert [each.reason for each in said] == ["loses 3 dB"] * 2


HEAD = '[[override]]\nmodule = "head"\ndtype = '


@pytest.mark.parametrize(
    ("text", "scheme", "left"),
    [
        # the product of queries and keys reads it, and so does that with the values
        ('[[override]]\nreads = "q"\ndtype = "float"', "full", ["Linear"]),
        # it beats the scheme: what can be int8 in that module is
        (f'{HEAD}"int8"', "feature-ext", ["QK", "AV", "Linear"]),
        # the later of two counts
        (
            f'{HEAD}"float"\n[[override]]\nnodes = "*Linear"\ndtype = "int8"',
            *("full", ["Linear"]),
        ),
    ],
)
def test_what_overrides_of_readers_modules_and_names_leave(
    text: str, scheme: str, left: list[str]
) -> None:
    names = [f"/head/{name}" for name in left]
    assert chosen(planned(text, scheme)) == ["/backbone/Conv", *names]


def test_names_of_the_source_file_match_too() -> None:
    model = conv_attention()
    node = model.graph[0]
    provenance.stamp(node, Provenance("backbone", ("/stem/conv", "/stem/bn"), ("x",)))
    overrides = Overrides.parse('[[override]]\nnodes = "/stem/*"\ndtype = "float"')

    plan = make_plan(model, FULL, PAPER, overrides=overrides)

    assert plan.decisions[0].rule == "override"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            '[[override]]\nnodes = "/planner/*"\ndtype = "float"',
            r"override nodes '/planner/\*' matches none of 10 nodes",
        ),
        (
            '[[override]]\nop = "Softmax"\ndtype = "int8"',
            "override op 'Softmax': /head/Softmax cannot be int8: Softmax in|is no",
        ),
        ('[[override]]\ndtype = "float"', "none of nodes, module, op and reads is giv"),
        ('[[override]]\nop = "Conv"\ndtype = "fp8"', "dtype fp8: only int8 and float"),
        ('[[override]]\nop = "Conv"\ndtype = "int4"', "dtype int4: only int8 and"),
        ('[[overide]]\nop = "Conv"\ndtype = "int8"', "overide: Extra inputs"),
        ("[[override", "not TOML"),
    ],
)
def test_what_is_wrong_with_overrides_is_one_line(text: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message) as caught:
        planned(text)
    assert "\n" not in str(caught.value)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"none\.toml: no such file of overrides"):
        Overrides.load(tmp_path / "none.toml")


def test_many_overrides_read_the_past_of_a_node_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, read, whole = conv_attention(), list[str](), provenance.read
    text = '[[override]]\nnodes = "/head/*"\ndtype = "float"\n'

    def counted(node: ir.Node) -> Provenance | None:
        read.append(node.name or "")
        return whole(node)

    monkeypatch.setattr(provenance, "read", counted)
    Overrides.parse(text * 50).bind(model)

    assert len(read) == len(model.graph)
