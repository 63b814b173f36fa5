"""Every workflow is silent, and writes what its command writes."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import me2e_compress as me2e
from me2e_compress.commands.result import Result
from me2e_compress.manager import recipe
from tests.support.command import Command

Call = Callable[[], object]
MAP = "map.toml"

CASES: dict[str, tuple[str, Call]] = {
    "compress": (
        "compress dense.onnx -o out.onnx -r full --frames frames --map map.toml",
        lambda: me2e.compress(
            "dense.onnx",
            "out.onnx",
            recipe="full",
            frames="frames",
            options=me2e.CompressOptions(module_map=MAP),
        ),
    ),
    "compress, passes": (
        "compress in.onnx -o out.onnx --passes fold-constants,fuse-basic",
        lambda: me2e.compress(
            "in.onnx", "out.onnx", recipe.parse("fold-constants,fuse-basic")
        ),
    ),
    "calibrate": (
        "calibrate dense.onnx frames -o r.json --map map.toml --method mse",
        lambda: me2e.calibrate(
            "dense.onnx",
            "frames",
            "r.json",
            me2e.CalibrateOptions(method="mse", module_map=MAP),
        ),
    ),
    "plan": (
        "plan dense.onnx -o p.json --map map.toml --rules paper",
        lambda: me2e.plan(
            "dense.onnx",
            "p.json",
            options=me2e.PlanOptions(rules="paper", module_map=MAP),
        ),
    ),
    "sensitivity": (
        "sensitivity dense.onnx frames -o s.toml --map map.toml --limit 1",
        lambda: me2e.measure_sensitivity(
            "dense.onnx",
            "frames",
            "s.toml",
            me2e.SensitivityOptions(limit=1.0, module_map=MAP),
        ),
    ),
    "record_frames": (
        "frames highway -n 1 -o made --seed 3",
        lambda: me2e.record_frames(
            "highway", "made", me2e.FramesOptions(count=1, seed=3)
        ),
    ),
    "evaluate": (
        "evaluate blind -o results --routes ParkedObstacle_R2_0 --latency fps:4",
        lambda: me2e.evaluate(
            "blind",
            "results",
            me2e.EvaluateOptions(routes="ParkedObstacle_R2_0", latency="fps:4"),
        ),
    ),
}


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize("name", CASES)
def test_a_workflow_is_silent_and_writes_what_its_command_writes(
    command: Command,
    dense: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    name: str,
) -> None:
    line, call = CASES[name]
    other = tmp_path_factory.mktemp("python") / "folder"
    shutil.copytree(dense, other)
    monkeypatch.chdir(dense)
    assert command(*line.split()) == 0
    capfd.readouterr()

    monkeypatch.chdir(other)
    result = call()

    assert capfd.readouterr() == ("", "")
    assert written(other) == written(dense)
    if isinstance(result, Result):
        assert "\n" not in result.headline
        assert result.headline in repr(result)


def written(folder: Path) -> dict[str, object]:
    """Read every file but logs and times; of a report all but the seconds."""
    return {
        str(path.relative_to(folder)): content(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".log"
    }


def content(path: Path) -> object:
    if not path.name.endswith(".report.json"):
        return path.read_bytes()
    record = json.loads(path.read_text(encoding="utf-8"))
    for step in record["steps"]:
        del step["seconds"]
    return record
