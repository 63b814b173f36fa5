import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.marks import IN_JSON
from me2e_compress.quantization.plan import KeptFloat, load_plan, plan_of, save_plan
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults
from tests.nets import net


def compressed(command: Command, dense: Path, *more: str | Path) -> Path:
    output = dense / "out.onnx"
    options = ("--scheme", "prediction", "--frames", dense / "frames")
    place = ("--map", dense / "map.toml", "-o", output)
    assert command("compress", dense / "dense.onnx", *options, *place, *more) == 0
    return output


def test_a_quantized_file_has_its_plan_beside_it_and_inside(
    command: Command, dense: Path
) -> None:
    output = compressed(command, dense)

    saved = load_plan(dense / "out.plan.json")
    assert saved == plan_of(graph.load(output))
    assert [each.node for each in saved.chosen] == ["/plan_head/MatMul"]


def test_the_plan_that_is_shown_is_the_one_that_is_made(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    compressed(command, dense)
    capsys.readouterr()
    words = ("--scheme", "prediction", "--map", dense / "map.toml", "--json")

    assert command("plan", dense / "dense.onnx", *words) == 0

    shown = json.loads(capsys.readouterr().out)
    saved = json.loads((dense / "out.plan.json").read_text())
    known = {key: shown[key] for key in saved if key in shown}
    assert saved == IN_JSON | known
    assert faults("plan", shown) == []


def test_plans_are_compared(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = compressed(command, dense)
    capsys.readouterr()
    words = ("--scheme", "feature-ext", "--rules", "paper")
    more = ("--map", dense / "map.toml", "--against", output)

    assert command("plan", dense / "dense.onnx", *words, *more) == 0

    said = capsys.readouterr().out
    assert "/plan_head/MatMul: int8 (layer) -> float (module)" in said
    assert "1 differences" in said
    assert command("plan", dense / "dense.onnx", *words, *more, "--json") == 0
    document = strict(capsys.readouterr().out)
    assert faults("plan", document) == []
    (found,) = document["differences"]
    assert [found[side]["rule"] for side in ("old", "new")] == [
        "layer",
        "module",
    ]


def test_what_overrides_change_is_told_against_the_same_model(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dense / "o.toml").write_text('[[override]]\nop = "MatMul"\ndtype = "float"\n')
    model, map_ = dense / "dense.onnx", ("--map", dense / "map.toml")
    words = (*map_, "--overrides", dense / "o.toml", "--against", model)

    assert command("plan", model, *words) == 0

    said = capsys.readouterr().out
    assert "/plan_head/MatMul: int8 (layer) -> float (override)" in said
    assert "1 differences" in said


@pytest.mark.parametrize("file", ["out.onnx", "out.plan.json"])
@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("--scheme full", "scheme"),
        ("--rules paper", "rules"),
        ("--overrides none.toml", "overrides"),
        ("--overrides none.toml --against dense.onnx", "overrides"),
        ("--scheme full --against out.plan.json", "scheme"),
    ],
)
def test_options_are_not_for_a_plan_that_is_made(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    words: str,
    option: str,
) -> None:
    compressed(command, dense)
    monkeypatch.chdir(dense)
    capsys.readouterr()

    assert command("plan", file, *words.split()) == 1

    error = capsys.readouterr().err
    assert f"--{option} is for a plan that is yet to be made, and {file} has" in error


def test_a_plan_is_shown_with_reasons(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--scheme", "feature-ext", "--map", dense / "map.toml")

    assert command("plan", dense / "dense.onnx", *words, "--nodes") == 0

    said = capsys.readouterr().out
    assert "0 of 2 nodes int8; module 1" in said
    assert "/plan_head/MatMul" in said


def test_what_is_decided_together_is_listed(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = net(
        '<ir_version: 9, opset_import: ["" : 17]>'
        "two (float[4,32] x, float[32,32] v, float[32,32] w)"
        " => (float[4,32] k, float[4,32] q) { k = MatMul(x, v) q = MatMul(x, w) }",
        {"v": np.eye(32), "w": np.ones((32, 32))},
    )
    graph.save(model, tmp_path / "two.onnx")
    (tmp_path / "map.toml").write_text(
        '[modules.head]\nrole = "prediction"\noptional = ["**"]\n'
    )
    words = ("--map", tmp_path / "map.toml", "--nodes")

    assert command("plan", tmp_path / "two.onnx", *words) == 0

    assert "shared-input" in capsys.readouterr().out


def test_options_of_int8_reach_the_pass(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dense / "o.toml").write_text('[[override]]\nop = "MatMul"\ndtype = "float"\n')
    more = (
        "--overrides",
        dense / "o.toml",
        "--rules",
        "paper",
        "--json",
        "--allow-empty",
    )

    compressed(command, dense, *more)

    step = json.loads(capsys.readouterr().out)["steps"][-1]
    assert 'rules="paper"' in step["text"]
    assert "0 of 2 nodes int8; by rule: override 1" in step["notes"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("-r", "exact", "--target", "tensorrt"),
            "--target is for int8, and the",
        ),
        (
            ("--scheme", "full", "--target", "npu"),
            "no target 'npu'; there are tensorrt",
        ),
        (("--scheme", "int4"), "no scheme int4; there are feature-ext"),
        (("--scheme", "full", "--rules", "fp8"), "no rule set 'fp8'; there are safe"),
        (("--scheme", "full", "--overrides", "none.toml"), "none.toml: no such file"),
        (("--scheme", "full", "--ranges", "none.json"), "none.json"),
        (("--scheme", "full"), "needs recorded frames (--frames) or saved ranges"),
    ],
)
def test_what_int8_cannot_do_is_one_line(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    message: str,
) -> None:
    place = ("--map", dense / "map.toml", "-o", dense / "no.onnx")

    assert command("compress", dense / "dense.onnx", *words, *place) == 1

    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not (dense / "no.onnx").exists()


def test_a_quantized_graph_is_explained_not_quantized_again(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = compressed(command, dense)
    capsys.readouterr()
    words = ("--scheme", "prediction", "--frames", dense / "frames")

    again = command("compress", output, *words, "-o", dense / "twice.onnx")

    assert again == 1
    assert "quantized already: 2 DequantizeLinear, 1 Quantize" in (
        capsys.readouterr().err
    )


def test_what_a_target_kept_in_float_is_counted(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    compressed(command, dense)
    made = load_plan(dense / "out.plan.json")
    kept = tuple(KeptFloat(each.node, each.output, "slow") for each in made.chosen)
    save_plan(dataclasses.replace(made, kept_float=kept), dense / "kept.plan.json")
    capsys.readouterr()

    assert command("plan", dense / "kept.plan.json") == 0

    said = " ".join(capsys.readouterr().out.split())
    assert "1 of them stay float on their target" in said


def test_a_close_decision_says_so_without_markup(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    compressed(command, dense)
    made = load_plan(dense / "out.plan.json")
    close = tuple(
        dataclasses.replace(each, reason="[8,8]", borderline="near 512")
        for each in made.decisions
    )
    save_plan(dataclasses.replace(made, decisions=close), dense / "close.plan.json")
    capsys.readouterr()

    assert command("plan", dense / "close.plan.json", "--nodes") == 0

    said = " ".join(capsys.readouterr().out.split())
    assert "[8,8]" in said
    assert "(near" in said
    assert "bold" not in said


def test_a_model_that_ships_is_compared_by_name(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = compressed(command, dense).with_name("out.plan.json")

    assert command("plan", saved, "--against", "none.onnx") == 1
    assert "none.onnx: no such file; models that ship" in capsys.readouterr().err


@pytest.mark.parametrize("words", [(), ("-v",), ("--nodes",), ("--nodes", "-v")])
def test_nodes_are_listed_once_and_only_when_asked_for(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
) -> None:
    place = ("--map", dense / "map.toml", "--scheme", "full")

    assert command("plan", dense / "dense.onnx", *place, *words) == 0

    said = capsys.readouterr().out
    assert "Decisions by module and rule" in said
    assert said.count("/plan_head/MatMul") == bool(words)
