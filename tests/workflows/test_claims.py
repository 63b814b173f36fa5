import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from me2e_compress import drafts
from me2e_compress.errors import GraphError
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.workflows.claims import RECORD, check_ours, writing

THEIRS = "is there, and not as me2e-compress left it"


def write(path: Path, text: str = "ours") -> None:
    with writing([path]):
        path.write_text(text)


def test_a_file_of_the_user_stays(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("theirs")
    with pytest.raises(GraphError, match=THEIRS):
        write(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "theirs"
    assert [file.name for file in tmp_path.iterdir()] == ["out"]


def test_a_file_of_the_user_goes_by_force(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("theirs")
    with writing([tmp_path / "out"], force=True):
        (tmp_path / "out").write_text("ours")
    write(tmp_path / "out", "again")


def test_what_we_wrote_is_written_again(tmp_path: Path) -> None:
    write(tmp_path / "out")
    write(tmp_path / "out", "again")
    assert (tmp_path / "out").read_text() == "again"


def test_what_we_wrote_and_the_user_changed_stays(tmp_path: Path) -> None:
    write(tmp_path / "out")
    (tmp_path / "out").write_text("theirs now")
    with pytest.raises(GraphError, match=THEIRS):
        check_ours([tmp_path / "out"])


def test_a_run_that_failed_owns_what_it_wrote_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "theirs").write_text("theirs")

    def fail() -> None:
        with writing([tmp_path / "new", tmp_path / "theirs"], force=True):
            (tmp_path / "new").write_text("half")
            raise ValueError("full")

    with pytest.raises(ValueError, match="full"):
        fail()
    check_ours([tmp_path / "new"])
    with pytest.raises(GraphError, match=THEIRS):
        check_ours([tmp_path / "theirs"])


def test_looking_first_changes_nothing_of_what_is_known(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("study.json", "tables.md", "report.html")]
    with writing(files):
        for file in files:
            file.write_text(file.name)
    known = (tmp_path / RECORD).read_text()
    check_ours(files)
    assert (tmp_path / RECORD).read_text() == known


def test_outputs_that_are_not_written_stay_ours(tmp_path: Path) -> None:
    files = [tmp_path / "one", tmp_path / "other"]
    with writing(files):
        for file in files:
            file.write_text(file.name)
    with writing(files):
        pass
    check_ours(files)


def test_a_run_without_an_output_leaves_no_record(tmp_path: Path) -> None:
    with writing([tmp_path / "out"], folders=[tmp_path / "folder"]):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_ours_as_a_whole(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    with writing(trees=[folder]):
        folder.mkdir()
        (folder / "000000.npz").write_text("ours")
    with writing(trees=[folder]):
        pass
    (folder / "000001.npz").write_text("theirs")
    with pytest.raises(GraphError, match=THEIRS), writing(trees=[folder]):
        pass


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["pipe", "folder"])
def test_only_regular_files_are_replaced(tmp_path: Path, make: object) -> None:
    make(tmp_path / "out")  # type: ignore[operator]
    with (
        pytest.raises(GraphError, match=r"name a file"),
        writing([tmp_path / "out"], force=True),
    ):
        pass


def test_a_device_is_no_output() -> None:
    with pytest.raises(GraphError, match="is a device or a pipe"):
        write(Path("/dev/null"))


BUSY = """
import sys
from pathlib import Path
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.workflows.claims import writing
out = Path(sys.argv[1])
with writing([out], folders=[out.parent / "results"]):
    write_bytes(out, b"half")
    print("busy", flush=True)
    sys.stdin.read()
"""


def test_one_writes_at_a_time_and_a_killed_run_is_gone_on_with(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with subprocess.Popen(
        [sys.executable, "-c", BUSY, out],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"busy\n"
        with pytest.raises(GraphError, match="out is in use: another me2e-compress"):
            write(out)
        with (
            pytest.raises(GraphError, match="results is in use"),
            writing(folders=[tmp_path / "results"]),
        ):
            pass
        write(tmp_path / "beside")  # another output of the same folder
        other.kill()
    assert "next" in json.loads((tmp_path / RECORD).read_text())["out"]
    write(out)
    assert out.read_text() == "ours"


@pytest.mark.parametrize("text", ["", "[", "[]", '{"out": 7}', '{"out": {"left": 7}}'])
def test_a_record_that_says_nothing_owns_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / RECORD).write_text(text)
    (tmp_path / "out").write_text("theirs")
    with pytest.raises(GraphError, match=THEIRS):
        write(tmp_path / "out")


Kept = Callable[[], None]


def kills(
    monkeypatch: pytest.MonkeyPatch, folder: Path, work: Kept, copies: Path
) -> list[Path]:
    """Copy a folder as a kill would leave it: before each write, and in its middle."""
    made = list[Path]()

    def keep() -> None:
        made.append(shutil.copytree(folder, copies / str(len(made)), symlinks=True))

    def first(call: Callable[..., object]) -> Callable[..., object]:
        def kept(*given: object, **options: object) -> object:
            keep()
            return call(*given, **options)

        return kept

    def halved(handle: int, content: bytes, place: int) -> int:
        keep()
        pwrite(handle, content[: len(content) // 2], place)
        keep()
        return pwrite(handle, content, place)

    pwrite = os.pwrite
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", halved)
        for name in ("replace", "ftruncate", "unlink"):
            patch.setattr(os, name, first(getattr(os, name)))
        work()
    keep()
    return made


@pytest.mark.parametrize("runs_before", [0, 1])
def test_what_a_kill_leaves_is_gone_on_with_and_what_users_change_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs_before: int
) -> None:
    names = ("study.json", "tables.md")
    folder = tmp_path / "study"
    folder.mkdir()

    def run(where: Path = folder, text: str = "written once more") -> None:
        files = [where / name for name in names]
        check_ours(files)
        with writing(files):
            for file in files:
                write_bytes(file, text.encode())

    for _ in range(runs_before):
        run(text="written")
    copies = kills(monkeypatch, folder, run, tmp_path / "copies")
    assert len(copies) > 20
    for copy in copies:
        check_ours(there := [copy / name for name in names if (copy / name).exists()])
        for file in there:
            ours, about = file.read_text(), file.stat()
            file.write_text("changed by me")
            with pytest.raises(GraphError, match=THEIRS):
                check_ours([file])
            file.write_text(ours)
            os.utime(file, ns=(about.st_atime_ns, about.st_mtime_ns))
        run(copy)
        check_ours([copy / name for name in names])


def test_a_folder_that_a_kill_left_half_replaced_is_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    top = tmp_path / "top"
    top.mkdir()

    def run(where: Path = top) -> None:
        with writing(trees=[where / "frames"]):
            (where / "draft").mkdir(exist_ok=True)
            (where / "draft" / "000000.npz").write_text("ours")
            drafts.put(where / "draft", where / "frames")

    run()
    for copy in kills(monkeypatch, top, run, tmp_path / "copies"):
        run(copy)
        left = (each.name for each in copy.iterdir())  # what stood there may wait aside
        shown = sorted(each for each in left if not each.startswith(".frames."))
        assert shown == [RECORD, "frames"]
