import json
import re
from pathlib import Path

import pytest

from me2e_compress import graph
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults

MODELLED = "modelled J"


def test_sensitivity_writes_a_recipe_that_compresses(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    map_ = ("--map", dense / "map.toml")
    done = command(
        *("sensitivity", dense / "dense.onnx", dense / "frames", *map_),
        *("--limit", "1", "-o", dense / "r.toml"),
    )
    shown = capsys.readouterr().out
    assert done == 0
    assert "planner" in shown
    assert "limit 1" in shown

    out = ("--frames", dense / "frames", "-o", dense / "out.onnx")
    how = ("-r", dense / "r.toml", *map_, *out)
    assert command("compress", dense / "dense.onnx", *how) == 0
    ops = [node.op_type for node in graph.load(dense / "out.onnx").graph]
    assert "QuantizeLinear" in ops


def test_a_limit_that_int8_cannot_keep_leaves_the_graph_float(
    command: Command, dense: Path
) -> None:
    command(
        *("sensitivity", dense / "dense.onnx", dense / "frames"),
        *("--map", dense / "map.toml", "--limit", "0", "-o", dense / "r.toml"),
    )

    assert "quantize-int8" not in (dense / "r.toml").read_text()


def test_saved_ranges_are_taken_and_stale_ones_refused(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, frames = dense / "dense.onnx", dense / "frames"
    map_ = ("--map", dense / "map.toml")
    command("calibrate", model, frames, *map_, "-o", dense / "ranges.json")
    words = ("sensitivity", model, frames, *map_, "-o", dense / "r.toml")

    assert command(*words, "--ranges", dense / "ranges.json") == 0
    stale = json.loads((dense / "ranges.json").read_text()) | {"model": "other"}
    (dense / "ranges.json").write_text(json.dumps(stale))
    assert command(*words, "--ranges", dense / "ranges.json") == 1
    assert "stale: of graph other" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "rows"), [("sensitivity", "findings"), ("search --max-mb 1", "tried")]
)
def test_programs_get_json_and_the_recipe(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    line: str,
    rows: str,
) -> None:
    name, *how = line.split()
    place = ("--map", dense / "map.toml", "-o", dense / "r.toml")
    words = (dense / "dense.onnx", dense / "frames", *place)

    assert command(name, *words, *how, "--json") == 0

    found = strict(capsys.readouterr().out)
    assert faults(name, found) == []
    assert len(found[rows]) == 1
    assert (dense / "r.toml").is_file()


@pytest.mark.parametrize("line", ["sensitivity", "search --max-mb 1"])
def test_ranges_of_another_tool_are_taken(
    command: Command, dense: Path, line: str
) -> None:
    place = ("--map", dense / "map.toml")
    model, frames = dense / "dense.onnx", dense / "frames"
    cache, saved = dense / "trt.cache", dense / "ranges.json"
    ours = ("calibrate", model, frames, *place, "-o", saved)
    command(*ours, "--tensorrt-cache", cache)
    command("calibrate", model, "--import", cache, *place, "-o", saved)
    name, *how = line.split()

    words = (*how, "--ranges", saved, *place, "-o", dense / "r.toml")
    assert command(name, model, frames, *words) == 0
    assert json.loads(saved.read_text())["method"] == "imported"


@pytest.mark.parametrize(
    ("budget", "int8"), [(("--max-mb", "1"), False), (("--max-mb", "0.001"), True)]
)
def test_search_writes_the_least_int8_that_fits(
    command: Command, dense: Path, budget: tuple[str, str], int8: bool
) -> None:
    done = command(
        *("search", dense / "dense.onnx", dense / "frames", *budget),
        *("--map", dense / "map.toml", "-o", dense / "r.toml"),
    )

    assert done == 0
    assert ("quantize-int8" in (dense / "r.toml").read_text()) == int8


def test_search_keeps_size_time_and_energy_at_once(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("me2e_compress.workflows.search.joules_here", lambda: MODELLED)
    budgets = ("--max-ms", "10000", "--max-mb", "1", "--max-joules", "1")
    done = command(
        *("search", dense / "dense.onnx", dense / "frames", *budgets, "--json"),
        *("--map", dense / "map.toml", "-o", dense / "r.toml"),
    )

    assert done == 0
    found = strict(capsys.readouterr().out)
    assert faults("search", found) == []
    units = [each["unit"] for each in found["budgets"]]
    assert units == ["bytes of weights", "s", MODELLED]
    assert len(found["tried"][-1]["measured_costs"]) == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "give a budget"),
        (("--max-mb", "1", "--max-joules", "0"), "--max-joules is 0"),
        (
            ("--max-mb", "1", "--max-ms", "1e-9"),
            r"nothing fits .* 0\.000000000001 s: .* alone",
        ),
        (("--max-ms", "1", "--target", "tensorrt"), "use --target onnxruntime"),
        (("--max-mb", "0.0000001"), "nothing fits"),
        (("--max-mb", "1", "--scheme", "int4"), "no scheme int4; there are .*int8"),
    ],
)
def test_budgets_that_cannot_be_are_one_line(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    message: str,
) -> None:
    done = command(
        *("search", dense / "dense.onnx", dense / "frames", *words),
        *("--map", dense / "map.toml", "-o", dense / "r.toml"),
    )

    assert done == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(message, error)
