"""Weights that lie apart: read from any folder, and never from outside the model's."""

from pathlib import Path

import onnx_ir as ir
import pytest

from tests.support.command import Cli
from tests.support.frames import record
from tests.support.nets import conv_attention, image

M = "../models/m.onnx"
FROM_ELSEWHERE = (
    f"inspect {M}",
    f"plan {M}",
    f"lint {M}",
    f"calibrate {M} ../models/frames -o r.json",
    f"compare {M} {M} ../models/frames",
    f"profile {M} ../models/frames -o t.json",
    f"compress {M} -r full --target tensorrt --frames ../models/frames -o small.onnx",
)


@pytest.fixture
def elsewhere(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cli:
    """A folder that is not the model's, whose weights lie all apart."""
    home, away = tmp_path / "models", tmp_path / "elsewhere"
    home.mkdir()
    model = conv_attention()
    for node in model.graph:
        node.metadata_props.clear()
    ir.save(
        *(model, home / "m.onnx", "protobuf"),
        external_data="weights.bin",
        size_threshold_bytes=0,
    )
    record(home / "frames", [image(0), image(1)])
    away.mkdir()
    monkeypatch.chdir(away)
    return Cli(cli.command, away, cli.capsys)


@pytest.mark.parametrize("line", FROM_ELSEWHERE)
def test_a_model_with_external_weights_works_from_any_folder(
    elsewhere: Cli, line: str
) -> None:
    elsewhere.done(line)


@pytest.mark.parametrize("at", [0, 2, 6])
def test_weights_outside_the_model_s_folder_are_not_read(
    elsewhere: Cli, tmp_path: Path, at: int
) -> None:
    weights = tmp_path / "models" / "weights.bin"
    weights.rename(tmp_path / "private.bin")
    weights.symlink_to(tmp_path / "private.bin")

    said = elsewhere.refused(FROM_ELSEWHERE[at])

    assert "the data of tokens lie at 'weights.bin'" in said
    assert "private.bin, outside the model's folder: not read" in said
