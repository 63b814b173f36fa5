"""``plan``: decisions that are explained and overridden."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.base.atomic import IN_JSON
from me2e_compress.quantization.decision import KeptFloat, load_plan, plan_of, save_plan
from tests.support.command import Cli
from tests.support.nets import net

MAP = "--map map.toml"
MADE = f"compress dense.onnx --scheme prediction --frames frames {MAP} -o out.onnx"


def test_the_plan_that_is_shown_is_the_one_beside_the_file(
    cli: Cli, dense: Path
) -> None:
    cli.done(MADE)
    saved = load_plan(dense / "out.plan.json")
    assert saved == plan_of(graph.load(dense / "out.onnx"))
    assert [each.node for each in saved.chosen] == ["/plan_head/MatMul"]

    shown = cli.document(f"plan dense.onnx --scheme prediction {MAP}")

    written = json.loads((dense / "out.plan.json").read_text())
    assert written == IN_JSON | {k: shown[k] for k in written if k in shown}


OVERRIDE = '[[override]]\nop = "MatMul"\ndtype = "float"\n'


def test_overrides_reach_the_plan_and_the_pass(cli: Cli, dense: Path) -> None:
    (dense / "o.toml").write_text(OVERRIDE)

    said = cli.done(f"plan dense.onnx {MAP} --overrides o.toml").out
    assert "0 of 2 nodes int8; override 1" in said
    options = me2e.CompressOptions(
        scheme="prediction", rules="paper", overrides="o.toml",
        module_map="map.toml", allow_empty=True,
    )  # fmt: skip
    me2e.compress("dense.onnx", "out.onnx", None, "frames", options)
    step = json.loads((dense / "out.report.json").read_text())["steps"][-1]
    assert 'rules="paper"' in step["text"]
    assert "0 of 2 nodes int8; override 1" in step["notes"][1]


@pytest.mark.usefixtures("dense")
@pytest.mark.parametrize("file", ["out.onnx", "out.plan.json"])
@pytest.mark.parametrize(
    "words", ["--scheme full", "--rules paper", "--overrides none.toml"]
)
def test_options_are_not_for_a_made_plan(cli: Cli, file: str, words: str) -> None:
    cli.done(MADE)

    said = cli.refused(f"plan {file} {words}")

    option = words.split()[0]
    assert f"{option} is for a plan that is yet to be made, and {file} has" in said


def test_what_a_concat_joins_is_listed(cli: Cli, tmp_path: Path) -> None:
    model = net(
        "two (float[4,32] x, float[32,32] v, float[64,32] w) => (float[4,32] q)"
        " { k = MatMul(x, v) c = Concat<axis=1>(x, k) q = MatMul(c, w) }",
        {"v": np.eye(32), "w": np.ones((64, 32))},
    )
    graph.save(model, tmp_path / "two.onnx")
    (tmp_path / "map.toml").write_text(
        '[modules.head]\nrole = "prediction"\noptional = ["**"]\n'
    )

    assert "On one scale" in cli.done(f"plan two.onnx {MAP} -v").out


def test_what_a_target_kept_is_shown(cli: Cli, dense: Path) -> None:
    cli.done(MADE)
    made = load_plan(dense / "out.plan.json")
    kept = tuple(KeptFloat(each.node, each.output, "slow") for each in made.chosen)
    wide = tuple(dataclasses.replace(each, reason="[8,8]") for each in made.decisions)
    changed = dataclasses.replace(made, kept_float=kept, decisions=wide)
    save_plan(changed, dense / "kept.plan.json")

    said = cli.done("plan kept.plan.json -v").words

    assert "1 of them stay float on their target" in said
    assert "[8,8]" in said
    assert "bold" not in said


@pytest.mark.usefixtures("dense")
@pytest.mark.parametrize("words", ["", "-v"])
def test_nodes_are_listed_once_and_only_when_asked_for(cli: Cli, words: str) -> None:
    said = cli.done(f"plan dense.onnx {MAP} --scheme full {words}").out

    assert "Decisions by module and rule" in said
    assert "of 2 nodes int8; " in said
    assert said.count("/plan_head/MatMul") == bool(words)
