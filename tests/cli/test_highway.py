"""The driver that really ships, no frames recorded yet: what is typed first."""

import json
from pathlib import Path

from tests.cli.conftest import Command


def test_exact_passes_need_no_frames(command: Command, tmp_path: Path) -> None:
    output = tmp_path / "exact.onnx"

    assert command("compress", "highway", "-r", "exact", "-o", str(output)) == 0

    report = json.loads((tmp_path / "exact.report.json").read_bytes())
    (check,) = report["verifications"]
    assert check["inputs"] == "recorded"
    assert check["unsteady"] == []
    assert check["errors"]["plan"] < 1e-5
    assert check["errors"]["occupancy"] < 1e-5
