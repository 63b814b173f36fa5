"""What ``--json`` prints of files that are written."""

from pathlib import Path

import pytest

from me2e_compress.cli.console import print_json
from me2e_compress.workflows.export import ExportResult
from me2e_compress.workflows.frames import FramesOptions, FramesResult
from me2e_compress.zoo.weights_record import WeightsRecord
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults


def test_an_exported_stack(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "m.onnx"

    assert command("export", "highway", "-o", output, "--json") == 0

    found = strict(capsys.readouterr().out)
    assert faults("export", found) == []
    assert found["bytes"] == output.stat().st_size


def test_a_stack_of_a_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "m.onnx"
    output.write_bytes(b"1234")
    record = WeightsRecord("a.pth", "0" * 64, epoch=3, converted={"float16": 9})

    print_json(ExportResult("tcp", output, 17, record).document())

    found = strict(capsys.readouterr().out)
    assert faults("export", found) == []
    assert found["weights"]["epoch"] == 3


def test_recorded_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("000000.npz", "000001.npz"):
        (tmp_path / name).touch()

    print_json(FramesResult("vad-tiny", tmp_path, FramesOptions(count=3)).document())

    found = strict(capsys.readouterr().out)
    assert faults("frames", found) == []
    assert found["frames"] == 2, "those that there are, not those that were asked for"
