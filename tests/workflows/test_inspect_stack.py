"""Inspection of a stack: what feeds what, and what the joined graph holds."""

from pathlib import Path

import pytest

import me2e_compress as me2e
from tests.cli.conftest import Command, command, strict
from tests.docs.documents import faults
from tests.stacks import THREE_FILES, dense_frames, write_dense, write_stack

__all__ = ["command"]


def test_what_feeds_every_input_of_every_file(tmp_path: Path) -> None:
    found = me2e.inspect(write_stack(tmp_path, THREE_FILES))

    assert [(each.file, each.input, each.source) for each in found.fed] == [
        ("backbone", "img", "frames"),
        ("head.first_frame", "feats", "backbone.feats"),
        ("head", "feats", "backbone.feats"),
        ("head", "prev_bev", "state: next_bev"),
    ]


def test_one_map_serves_all_files(tmp_path: Path) -> None:
    map_file = tmp_path / "map.toml"
    map_file.write_text(
        '[modules.a]\nrole = "feature"\npatterns = ["backbone"]\n'
        '[modules.b]\nrole = "prediction"\npatterns = ["head"]\n'
    )

    found = me2e.inspect(write_dense(tmp_path), map_file)

    assert [(each.module, each.nodes, each.parameters) for each in found.modules] == [
        *(("a", 2, 512), ("b", 3, 1024))
    ]


def test_the_document_says_it_all(
    tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = THREE_FILES.replace("head_first", "head") + (
        '[state]\nprev_bev = {first = "head.learned"}\n'
    )

    assert command("inspect", write_stack(tmp_path, toml), "--json") == 0

    found = strict(capsys.readouterr().out)
    assert faults("inspect", found) == []
    assert found["first_values"] == {"prev_bev": "head.learned"}


@pytest.mark.parametrize("toml", [None, THREE_FILES])
def test_time_is_that_of_the_joined_graph(tmp_path: Path, toml: str | None) -> None:
    stack = write_dense(tmp_path, toml) if toml else write_dense(tmp_path)

    found = me2e.inspect(stack, frames=dense_frames(tmp_path))

    assert found.latency_of
