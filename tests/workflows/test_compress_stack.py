"""A stack of several files is compressed and measured as one graph."""

import json
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

import me2e_compress as me2e
from me2e_compress import graph
from me2e_compress.errors import (
    FramesError,
    GraphError,
    ModuleMapError,
)
from me2e_compress.graph import JoinedStack
from me2e_compress.manager import recipe
from me2e_compress.registry.marks import IN_JSON
from tests.command import Command, strict
from tests.docs.documents import faults
from tests.stacks import (
    THREE_FILES,
    TWO_MODULES,
    TWO_PARTS,
    dense_frames,
    write_dense,
    write_stack,
)

NO_CHECKS = me2e.CompressOptions(verify_frames=0)


def int8_layers(path: Path) -> int:
    found = ir.load(path).graph
    return sum(node.op_type == "DequantizeLinear" for node in found)


def test_every_file_becomes_int8_and_the_whole_is_measured(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path, THREE_FILES), dense_frames(tmp_path)

    found = me2e.compress(stack, tmp_path / "small", "full", frames)

    files = ("head", "head.first_frame", "backbone")
    assert found.output == tmp_path / "small" / "stack.toml"
    assert all(int8_layers(tmp_path / "small" / f"{name}.onnx") for name in files)
    assert found.loss is not None
    assert found.loss.fidelity is not None
    assert found.loss.fidelity.frames == 1
    (first,) = found.first_frames.values()
    assert first.output == tmp_path / "small" / "head.first_frame.onnx"
    assert first.loss is not None
    assert first.loss.fidelity is not None
    outputs = (*found.loss.fidelity.outputs, *first.loss.fidelity.outputs)
    assert all(each.sqnr_db > 30 for each in outputs)
    assert me2e.compare(stack, found.output, frames).fidelity.missing == ()


def test_exact_passes_leave_the_whole_as_it_was_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    read, load = list[Path](), JoinedStack.load

    def noted(path: Path) -> JoinedStack:
        read.append(path)
        return load(path)

    with monkeypatch.context() as patch:
        patch.setattr(JoinedStack, "load", noted)
        found = me2e.compress(stack, tmp_path / "small", "exact", frames)

    assert read == [stack]
    assert found.loss is None
    outputs = me2e.compare(stack, found.output, frames).fidelity.outputs
    assert {each.error for each in outputs} == {0.0}


def test_the_first_value_goes_along(tmp_path: Path) -> None:
    toml = TWO_PARTS + '[state]\n"head.prev_bev" = {first = "head.learned"}\n'
    found = me2e.compress(write_stack(tmp_path, toml), tmp_path / "s", "exact")

    small = JoinedStack.load(found.output)

    assert small.first_values["prev_bev"].tolist() == [[1, 2, 3, 4]]
    assert small.path.parent / "first_value_0.npy" in graph.paths_of(small.path)


def test_the_report_holds_every_file_and_the_whole(
    tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    words = ("-r", "full", "--frames", frames, "-o", tmp_path / "small", "--json")

    assert command("compress", stack, *words) == 0

    found = strict(capsys.readouterr().out)
    assert faults("compress", found) == []
    report = json.loads((tmp_path / "small" / "stack.report.json").read_text())
    assert report["int8"]["nodes"] == 2
    known = {name: found[name] for name in report if name in found}
    assert report == IN_JSON | known | {"verdict": report["verdict"]}
    assert (tmp_path / "small" / "stack.plan.json").is_file()


def test_int8_asks_for_frames_of_the_stack(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match="needs recorded frames"):
        me2e.compress(write_dense(tmp_path), tmp_path / "small", "full")
    assert not (tmp_path / "small").exists()


def test_frames_that_do_not_fit_the_stack_are_named(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path), dense_frames(tmp_path)
    np.savez(frames / "000003.npz", image=np.zeros((4, 16), np.float32))

    with pytest.raises(FramesError, match=r"000003\.npz: img is missing; there is im"):
        me2e.compress(stack, tmp_path / "small", "full", frames)


def test_a_map_must_match_in_one_of_the_files(tmp_path: Path) -> None:
    stack, map_file = write_dense(tmp_path), tmp_path / "map.toml"
    map_file.write_text(TWO_MODULES.replace("head", "hat"))

    with pytest.raises(ModuleMapError, match="'hat' of module b matches no"):
        me2e.compress(
            *(stack, tmp_path / "small", "exact", None),
            me2e.CompressOptions(module_map=map_file),
        )


def test_a_scheme_takes_the_modules_of_its_file(tmp_path: Path) -> None:
    stack, map_file = write_dense(tmp_path), tmp_path / "map.toml"
    map_file.write_text(TWO_MODULES)
    options = me2e.CompressOptions(module_map=map_file, verify_frames=0)

    found = me2e.compress(
        stack, tmp_path / "small", "prediction", dense_frames(tmp_path), options
    )

    assert found.int8 is not None
    assert found.int8.nodes == 1
    assert not int8_layers(tmp_path / "small" / "backbone.onnx")
    assert int8_layers(tmp_path / "small" / "head.onnx")


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
        me2e.compress(stack, tmp_path / output, "exact")


def test_what_is_there_is_replaced_only_if_it_is_ours(tmp_path: Path) -> None:
    stack, small = write_dense(tmp_path), tmp_path / "small"
    for _ in range(2):
        me2e.compress(stack, small, "exact", None, NO_CHECKS)
    (small / "notes.txt").write_text("mine")

    with pytest.raises(GraphError, match="me2e-compress did not write it"):
        me2e.compress(stack, small, "exact", None, NO_CHECKS)


def test_the_small_stack_carries_its_plan(tmp_path: Path) -> None:
    stack, frames = write_dense(tmp_path, THREE_FILES), dense_frames(tmp_path)
    found = me2e.compress(stack, tmp_path / "small", "full", frames, NO_CHECKS)

    plan = me2e.plan(found.output).plan

    assert [each.node for each in plan.decisions if each.dtype == "int8"]
    assert {each.module for each in plan.decisions} == {"model"}


def test_a_module_is_ablated_across_files(tmp_path: Path) -> None:
    stack, map_file = write_dense(tmp_path), tmp_path / "map.toml"
    map_file.write_text(TWO_MODULES)
    options = me2e.CompressOptions(module_map=map_file, verify_frames=0)
    passes = recipe.parse("import-normalize,ablate-modules{drop=[b],drop_outputs=true}")

    found = me2e.compress(stack, tmp_path / "small", passes, None, options)

    small = JoinedStack.load(found.output)
    assert list(small.outputs) == ["feats"]
    assert list(small.files) == ["backbone"]
