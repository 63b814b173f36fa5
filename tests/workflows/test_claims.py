import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from me2e_compress.errors import GraphError
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
from me2e_compress.workflows.claims import writing
out = Path(sys.argv[1])
with writing([out], folders=[out.parent / "results"]):
    out.write_text("half")
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
    assert "writing" in json.loads((tmp_path / RECORD).read_text())["out"]
    write(out)
    assert out.read_text() == "ours"


@pytest.mark.parametrize("text", ["", "[", "[]", '{"out": 7}', '{"out": {"left": 7}}'])
def test_a_record_that_says_nothing_owns_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / RECORD).write_text(text)
    (tmp_path / "out").write_text("theirs")
    with pytest.raises(GraphError, match=THEIRS):
        write(tmp_path / "out")
