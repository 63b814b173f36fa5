"""A model in several files is joined, made smaller as one graph, and split again."""

import json
from pathlib import Path

import onnx_ir as ir
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.manager import recipe
from tests.support.command import Cli
from tests.support.stacks import BACKBONE, dense_frames, write_dense, write_stack

TWO_MODULES = """
[modules.a]
role = "feature"
patterns = ["backbone"]
[modules.b]
role = "prediction"
patterns = ["head"]
"""
"""A map with a module for each part."""


def test_what_feeds_every_input_of_every_file(tmp_path: Path) -> None:
    found = me2e.join(write_stack(tmp_path), tmp_path / "one.onnx")

    assert [(each.part, each.input, each.source) for each in found.fed] == [
        ("backbone", "img", "frames"),
        ("head", "feats", "backbone.feats"),
        ("head", "prev_bev", "state: next_bev"),
    ]
    assert found.parts == ("backbone", "head")
    assert found.file_bytes == (tmp_path / "one.onnx").stat().st_size


def test_int8_of_the_whole_stands_in_every_file(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    one, small = tmp_path / "one.onnx", tmp_path / "small.onnx"
    me2e.join(stack, one)
    me2e.compress(one, small, "full", frames)

    found = me2e.split(small, stack, tmp_path / "small")

    assert found.missing == ()
    for path in found.files.values():
        kinds = [node.op_type for node in ir.load(path).graph]
        assert "DequantizeLinear" in kinds
        assert me2e.plan(path).plan.decisions
    (tmp_path / "small" / "stack.toml").write_bytes(stack.read_bytes())
    again = me2e.join(tmp_path / "small" / "stack.toml", tmp_path / "again.onnx")
    outputs = me2e.compare(small, again.output, frames).fidelity.outputs
    assert {each.error for each in outputs} == {0.0}


def test_a_part_that_an_ablation_took_away_is_named(tmp_path: Path) -> None:
    stack, one = write_dense(tmp_path), tmp_path / "one.onnx"
    me2e.join(stack, one)
    (tmp_path / "map.toml").write_text(TWO_MODULES)
    options = me2e.CompressOptions(
        module_map=tmp_path / "map.toml", verify_frames=0, force=True
    )
    passes = recipe.parse("import-normalize,ablate-modules{drop=[b],drop_outputs=true}")
    me2e.compress(one, tmp_path / "small.onnx", passes, None, options)

    found = me2e.split(tmp_path / "small.onnx", stack, tmp_path / "small")

    assert found.missing == ("head",)
    assert [path.name for path in found.files.values()] == ["backbone.onnx"]
    assert found.alerts() == ("head: no output is left of it",)


def test_the_commands_join_and_split(cli: Cli, tmp_path: Path) -> None:
    write_dense(tmp_path)

    joined = cli.document("join stack.toml -o one.onnx")
    cut = cli.document("split one.onnx stack.toml -o cut")

    assert joined["parts"] == ["backbone", "head"]
    assert cut["files"] == {"head": "cut/head.onnx", "backbone": "cut/backbone.onnx"}
    assert json.loads(graph.load("one.onnx").metadata_props["me2e.recurrent"]) == {
        "prev_bev": "next_bev",
        "img": None,
    }


def test_nothing_of_the_users_is_lost(tmp_path: Path) -> None:
    stack, one = write_stack(tmp_path), tmp_path / "one.onnx"
    me2e.join(stack, one)

    with pytest.raises(GraphError, match=r"head\.onnx is the input"):
        me2e.join(stack, tmp_path / "head.onnx", force=True)
    with pytest.raises(GraphError, match="is the input"):
        me2e.split(one, stack, tmp_path, force=True)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "head.onnx").write_text("mine")
    with pytest.raises(GraphError, match="me2e-compress did not write it"):
        me2e.split(one, stack, tmp_path / "cut")
    with pytest.raises(GraphError, match=r"one\.onnx is a file: name a folder"):
        me2e.split(one, stack, one)


def test_a_graph_of_another_stack_is_refused(tmp_path: Path) -> None:
    stack = write_stack(tmp_path, other=BACKBONE.replace("feats", "more"))

    with pytest.raises(GraphError, match=r"other\.onnx: gives none of the outputs of "):
        me2e.split(tmp_path / "other.onnx", stack, tmp_path / "cut")
    with pytest.raises(
        GraphError, match=r"highway\.onnx: head cannot be cut out again"
    ):
        me2e.split("highway", stack, tmp_path / "cut")


@pytest.mark.parametrize(
    "line", ["inspect stack.toml", "compress stack.toml -r exact -o out.onnx"]
)
def test_a_command_that_takes_one_graph_says_so(
    cli: Cli, tmp_path: Path, line: str
) -> None:
    write_stack(tmp_path)

    assert cli.refused(line).endswith(
        "joined first: me2e-compress join stack.toml -o MODEL.onnx"
    )
