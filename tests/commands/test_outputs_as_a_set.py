"""What a command writes is there as a whole, or what was there before still is."""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.base import atomic
from me2e_compress.base.atomic import write_bytes
from me2e_compress.commands import compress
from tests.support.command import Command, contents
from tests.support.nets import parsed

COMPRESS = ("compress", "in.onnx", "-o", "out.onnx", "--passes")


@pytest.fixture
def full_at_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(compress, "write_document", full)


@pytest.mark.usefixtures("full_at_the_report")
def test_a_graph_whose_report_cannot_be_written_is_not_left(
    command: Command,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(files)
    before = contents(files)

    assert command(*COMPRESS, "import-normalize") == 1

    said = "me2e-compress: out.report.json: No space left on device\n"
    assert capsys.readouterr().err == said
    assert contents(files) == before


@pytest.mark.parametrize("external", [False, True])
def test_what_was_there_before_comes_back(
    command: Command,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    external: bool,
    request: pytest.FixtureRequest,
) -> None:
    monkeypatch.chdir(files)
    if external:
        model = parsed(
            "g (float[1,4] x) => (float[1,4] y) <float[1,4] w = {1, 2, 3, 4}>"
            " { y = Add(x, w) }"
        )
        graph.save(model, files / "in.onnx", external=True)
    assert command(*COMPRESS, "import-normalize") == 0
    before = contents(files)
    request.getfixturevalue("full_at_the_report")

    assert command(*COMPRESS, "import-normalize,fold-constants") == 1

    assert contents(files) == before
    monkeypatch.undo()
    monkeypatch.chdir(files)
    assert command(*COMPRESS, "import-normalize,fold-constants") == 0
    json.loads((files / "out.report.json").read_text())


def no_links(*_: object, **__: object) -> None:
    raise OSError(errno.EPERM, "no links here")


@pytest.mark.parametrize("link", [os.link, no_links], ids=["links", "no links"])
def test_files_that_are_removed_in_a_set_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, link: Callable[..., None]
) -> None:
    monkeypatch.setattr(os, "link", link)
    write_bytes(tmp_path / "old", b"old")
    write_bytes(tmp_path / "both", b"first")
    before = contents(tmp_path)

    def fail() -> None:
        with atomic.all_or_none():
            write_bytes(tmp_path / "both", b"second")
            write_bytes(tmp_path / "both", b"third")
            write_bytes(tmp_path / "new", b"new")
            atomic.remove(tmp_path / "old")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert contents(tmp_path) == before


def test_an_error_of_the_system_names_the_file_not_its_draft(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as error:
        write_bytes(tmp_path / "gone" / "file.json", b"")
    assert error.value.filename == str(tmp_path / "gone" / "file.json")
