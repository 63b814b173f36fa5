"""Plans on disk, in a model, and side by side."""

from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.errors import RecipeError
from me2e_compress.quantization.plan import (
    Overrides,
    differences,
    load_plan,
    make_plan,
    plan_of,
    save_plan,
    stamp_plan,
)
from me2e_compress.quantization.rules.rule_sets import PaperRules
from me2e_compress.quantization.scheme import QuantScheme
from tests.nets import MODULES, PAPER, conv_attention

FULL = QuantScheme.named("full", MODULES)


def test_a_saved_plan_reads_back_the_same(tmp_path: Path) -> None:
    plan = make_plan(conv_attention(), FULL, PAPER)

    save_plan(plan, tmp_path / "plan.json")

    assert load_plan(tmp_path / "plan.json") == plan


def test_a_model_carries_its_plan_through_a_file(tmp_path: Path) -> None:
    model = conv_attention()
    plan = make_plan(model, FULL, PAPER)

    stamp_plan(model, plan)
    graph.save(model, tmp_path / "m.onnx")

    assert plan_of(graph.load(tmp_path / "m.onnx")) == plan


def test_a_model_without_a_plan_has_none() -> None:
    assert plan_of(conv_attention()) is None


def test_differences_name_what_changed_and_by_which_rule() -> None:
    model = conv_attention()
    overrides = Overrides.parse('[[override]]\nop = "Conv"\ndtype = "float"')
    old = make_plan(model, FULL, PAPER)
    new = make_plan(model, FULL, PaperRules(attention_limit=8), overrides)

    assert [str(each) for each in differences(old, new)] == [
        "/backbone/Conv: int8 (layer) -> float (override)",
        "/head/QK: int8 (attention) -> float (attention-length)",
        "/head/AV: int8 (attention) -> float (attention-length)",
    ]
    assert not list(differences(old, old))


def test_nodes_that_only_one_plan_has_are_differences() -> None:
    model = conv_attention()
    old = make_plan(model, FULL, PAPER)
    model.graph[0].outputs[0].name = "renamed"
    new = make_plan(model, FULL, PAPER)

    assert [str(each) for each in differences(old, new)] == [
        "/backbone/Conv: none -> int8 (layer)",
        "/backbone/Conv: int8 (layer) -> none",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "not a plan: scheme: Field required"),
        ("no", "not a plan: the file: Invalid"),
    ],
)
def test_not_a_plan(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "plan.json").write_text(text)

    with pytest.raises(RecipeError, match=message):
        load_plan(tmp_path / "plan.json")


def test_no_such_plan(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"none\.json: no such plan"):
        load_plan(tmp_path / "none.json")
