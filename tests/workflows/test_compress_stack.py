"""A stack of several files is compressed file by file and measured as one model."""

import json
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

import me2e_compress as me2e
from me2e_compress.errors import (
    FramesError,
    GraphError,
    ModuleMapError,
    PreconditionError,
    RecipeError,
)
from me2e_compress.marks import IN_JSON
from me2e_compress.runtime.stack.split_stack import SplitStack
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults
from tests.stacks import THREE_FILES, TWO_PARTS, dense_frames, write_dense, write_stack

NO_CHECKS = me2e.CompressOptions(verify_frames=0)


def int8_layers(path: Path) -> int:
    found = ir.load(path).graph
    return sum(node.op_type == "DequantizeLinear" for node in found)


def test_every_file_becomes_int8_and_the_whole_is_measured(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path, THREE_FILES), dense_frames(tmp_path)

    found = me2e.compress_stack(stack, tmp_path / "small", "full", frames)

    files = ("head", "head.first_frame", "backbone")
    assert tuple(found.files) == files
    assert all(int8_layers(tmp_path / "small" / f"{name}.onnx") for name in files)
    assert found.loss is not None
    assert found.loss.fidelity is not None
    assert found.loss.fidelity.frames == 2
    assert all(each.sqnr_db > 30 for each in found.loss.fidelity.outputs)
    assert me2e.compare(stack, found.output, frames).fidelity.missing == ()


def test_exact_passes_leave_the_whole_as_it_was(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)

    found = me2e.compress_stack(stack, tmp_path / "small", "exact", frames)

    assert found.loss is None
    outputs = me2e.compare(stack, found.output, frames).fidelity.outputs
    assert {each.error for each in outputs} == {0.0}


def test_each_file_may_have_a_recipe_of_its_own(tmp_path: Path) -> None:
    toml = TWO_PARTS.replace('"head.onnx"', '"head.onnx"\nrecipe = "exact"')
    toml = toml.replace('"backbone.onnx"', '"backbone.onnx"\nrecipe = "full"')
    stack, frames = write_dense(tmp_path, toml), dense_frames(tmp_path)

    me2e.compress_stack(stack, tmp_path / "small", None, frames, NO_CHECKS)

    assert not int8_layers(tmp_path / "small" / "head.onnx")
    assert int8_layers(tmp_path / "small" / "backbone.onnx")


def test_a_file_without_a_recipe_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="head: say what to do: -r RECIPE"):
        me2e.compress_stack(write_dense(tmp_path), tmp_path / "small")


def test_the_first_value_goes_along(tmp_path: Path) -> None:
    toml = TWO_PARTS + '[state]\n"head.prev_bev" = {first = "head.learned"}\n'
    found = me2e.compress_stack(write_stack(tmp_path, toml), tmp_path / "s", "exact")

    small = SplitStack.load(found.output)

    assert small.first_values["prev_bev"].tolist() == [[1, 2, 3, 4]]
    assert small.path.parent / "first_value_0.npy" in small.paths()


def test_the_report_holds_every_file_and_the_whole(
    tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    words = ("-r", "full", "--frames", frames, "-o", tmp_path / "small", "--json")

    assert command("compress", stack, *words) == 0

    found = strict(capsys.readouterr().out)
    assert faults("compress", found) == []
    report = json.loads((tmp_path / "small" / "report.json").read_text())
    assert report["files"]["head"]["int8"]["nodes"] > 0
    known = {name: found[name] for name in report if name in found}
    assert report == IN_JSON | known


def test_int8_asks_for_frames_of_the_stack(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match="needs recorded frames"):
        me2e.compress_stack(write_dense(tmp_path), tmp_path / "small", "full")
    assert not (tmp_path / "small").exists()


def test_frames_that_do_not_fit_the_stack_are_named(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    np.savez(frames / "000003.npz", image=np.zeros((4, 16), np.float32))

    with pytest.raises(FramesError, match=r"000003\.npz: img is missing; there is im"):
        me2e.compress_stack(stack, tmp_path / "small", "full", frames)


def test_one_file_may_stay_float_but_not_all(tmp_path: Path) -> None:
    stack = write_stack(tmp_path)
    frames = dense_frames(tmp_path)
    for file in frames.glob("*.npz"):
        np.savez(file, img=np.ones((1, 4), np.float32))

    with pytest.raises(PreconditionError, match="--allow-empty writes it"):
        me2e.compress_stack(stack, tmp_path / "small", "full", frames, NO_CHECKS)


def test_a_map_must_match_in_one_of_the_files(tmp_path: Path) -> None:
    stack, map_file = write_dense(tmp_path), tmp_path / "map.toml"
    map_file.write_text(
        '[modules.a]\nrole = "feature"\npatterns = ["backbone"]\n'
        '[modules.b]\nrole = "prediction"\npatterns = ["hat"]\n'
    )

    with pytest.raises(ModuleMapError, match="'hat' of module b matches no"):
        me2e.compress_stack(
            *(stack, tmp_path / "small", "exact", None),
            me2e.CompressOptions(module_map=map_file),
        )


def test_a_scheme_takes_the_modules_of_its_file(tmp_path: Path) -> None:
    stack, map_file = write_dense(tmp_path), tmp_path / "map.toml"
    map_file.write_text(
        '[modules.a]\nrole = "feature"\npatterns = ["backbone"]\n'
        '[modules.b]\nrole = "prediction"\npatterns = ["head"]\n'
    )
    options = me2e.CompressOptions(module_map=map_file, verify_frames=0)

    found = me2e.compress_stack(
        stack, tmp_path / "small", "prediction", dense_frames(tmp_path), options
    )

    counts = {name: each.int8 and each.int8.nodes for name, each in found.files.items()}
    assert counts["backbone"] == 0
    assert counts["head"]


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ("small.onnx", "a stack is written as a folder"),
        (".", "is the input|is there, and me2e"),
    ],
)
def test_an_output_that_would_not_do(tmp_path: Path, output: str, said: str) -> None:
    stack = write_dense(tmp_path)

    with pytest.raises(GraphError, match=said):
        me2e.compress_stack(stack, tmp_path / output, "exact")


def test_what_is_there_is_replaced_only_if_it_is_ours(tmp_path: Path) -> None:
    stack, small = write_dense(tmp_path), tmp_path / "small"
    for _ in range(2):
        me2e.compress_stack(stack, small, "exact", None, NO_CHECKS)
    (small / "notes.txt").write_text("mine")

    with pytest.raises(GraphError, match="me2e-compress did not write it"):
        me2e.compress_stack(stack, small, "exact", None, NO_CHECKS)
