"""What is there is replaced if it says that it is ours, and else only by force."""

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.base.atomic import MARK
from me2e_compress.base.errors import GraphError
from me2e_compress.calibration.recording import partial_folder, write_recording
from me2e_compress.commands.checks import check_replaceable, writing
from me2e_compress.commands.frames import record_frames
from me2e_compress.runtime.frames import Frame
from me2e_compress.shipped import drivers as shipped

THEIRS = "is there, and me2e-compress did not write it"
OURS = f"# {MARK}\n"


def write(path: Path, text: str = OURS, *, force: bool = False) -> None:
    with writing([path], force=force):
        path.write_text(text)


def test_a_file_of_the_user_stays_unless_forced(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("theirs, for me2e-compress")
    with pytest.raises(GraphError, match=THEIRS):
        write(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "theirs, for me2e-compress"
    assert [file.name for file in tmp_path.iterdir()] == ["out"]
    write(tmp_path / "out", force=True)
    (tmp_path / "out").write_text(f"{OURS}and edited since\n")
    write(tmp_path / "out", f"{OURS}again")  # it says that we wrote it
    assert (tmp_path / "out").read_text() == f"{OURS}again"


def test_one_file_of_the_user_among_ours_stays(tmp_path: Path) -> None:
    (tmp_path / "one").write_text(OURS)
    (tmp_path / "other").write_text("theirs")
    with pytest.raises(GraphError, match=rf"other {THEIRS}"):
        check_replaceable([tmp_path / "one", tmp_path / "other"])


@pytest.mark.parametrize("target", ["ours", "nothing"])
def test_a_link_is_not_followed(tmp_path: Path, target: str) -> None:
    (tmp_path / "ours").write_text(OURS)
    (tmp_path / "out").symlink_to(target)
    with pytest.raises(GraphError, match=THEIRS):
        write(tmp_path / "out")
    assert (tmp_path / "ours").read_text() == OURS


@pytest.mark.parametrize("name", ["pipe", "folder", "/dev/null"])
def test_only_regular_files_are_replaced(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    with pytest.raises(GraphError, match="name a file"):
        write(tmp_path / name, force=True)


def test_a_copy_of_a_model_that_ships_is_replaced_and_a_link_to_it_is_not(
    tmp_path: Path,
) -> None:
    shipped.copy("highway", tmp_path / "copy.onnx")
    (tmp_path / "link.onnx").symlink_to("copy.onnx")
    check_replaceable([tmp_path / "copy.onnx"])
    with pytest.raises(GraphError, match=THEIRS):
        check_replaceable([tmp_path / "link.onnx"])


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A folder of ours, with a folder in it."""
    (tmp_path / "out" / "in").mkdir(parents=True)
    (tmp_path / "out" / "one").write_text(OURS)
    (tmp_path / "out" / "in" / "other").write_text(OURS)
    return tmp_path / "out"


def test_a_folder_is_ours_if_all_of_it_is(tree: Path) -> None:
    check_replaceable([], trees=[tree, tree.parent / "new"])
    (tree / "in" / "notes.txt").write_text("theirs")
    with pytest.raises(GraphError, match=THEIRS):
        check_replaceable([], trees=[tree])
    check_replaceable([], trees=[tree], force=True)


def test_a_link_in_a_folder_or_to_a_folder_is_not_ours(tree: Path) -> None:
    (tree.parent / "link").symlink_to(tree.name)
    with pytest.raises(GraphError, match=THEIRS):
        check_replaceable([], trees=[tree.parent / "link"])
    (tree / "in" / "link").symlink_to("other")
    with pytest.raises(GraphError, match=THEIRS):
        check_replaceable([], trees=[tree])


BUSY = """
import sys
from pathlib import Path
from me2e_compress.commands.checks import writing
with writing(folders=[Path(sys.argv[1])]):
    print("busy", flush=True)
    sys.stdin.read()
"""


def work(folder: Path) -> None:
    with writing(folders=[folder]):
        (folder / "result").write_text("one")


def test_one_works_in_a_folder_until_it_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "results"
    with subprocess.Popen(
        [sys.executable, "-c", BUSY, folder],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"busy\n"
        with pytest.raises(GraphError, match="results is in use: another me2e-compre"):
            work(folder)
        work(folder.with_name("beside"))
        other.kill()
    work(folder)
    assert [each.name for each in folder.iterdir()] == ["result"]


def test_a_file_system_without_locks_grants_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks here")

    monkeypatch.setattr(fcntl, "flock", none)
    work(tmp_path)


def test_a_folder_that_stayed_empty_goes_unless_it_was_there(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with writing(folders=[tmp_path / "there", tmp_path / "new"]):
        assert (tmp_path / "new").is_dir()
    assert [each.name for each in tmp_path.iterdir()] == ["there"]


def test_one_run_records_the_frames_of_a_folder(tmp_path: Path) -> None:
    with (
        writing(folders=[partial_folder(tmp_path / "out")]),
        pytest.raises(GraphError, match="partial is in use"),
    ):
        record_frames("highway", tmp_path / "out")


def test_unfinished_frames_of_another_run_are_cleared_under_the_lock(
    tmp_path: Path,
) -> None:
    partial = partial_folder(tmp_path / "out")
    partial.mkdir()
    for name in ("progress.json", "000007.npz"):
        (partial / name).write_text("{}")
    frame = Frame(0, True, {"camera": np.zeros((1, 4), np.float32)})

    def source(_: object) -> list[Frame]:
        with pytest.raises(GraphError, match="partial is in use"):
            work(partial)
        return [frame]

    with writing(folders=[partial]):
        write_recording(tmp_path / "out", source, {})
    names = sorted(each.name for each in (tmp_path / "out").iterdir())
    assert names == ["000000.npz", "scenes.json"]
    check_replaceable([], trees=[tmp_path / "out"])
