"""``sensitivity`` and ``search``: recipes by what int8 costs."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from me2e_compress import graph
from tests.support.command import Cli

F = "dense.onnx frames --map map.toml -o r.toml"


def test_sensitivity_writes_a_recipe_that_compresses(cli: Cli, dense: Path) -> None:
    shown = cli.done(f"sensitivity {F} --limit 1").out
    assert "planner" in shown
    assert "limit 1" in shown

    how = "-r r.toml --map map.toml --frames frames -o out.onnx"
    cli.done(f"compress dense.onnx {how}")
    ops = [node.op_type for node in graph.load(dense / "out.onnx").graph]
    assert "QuantizeLinear" in ops


@pytest.mark.parametrize(
    ("line", "rows", "int8"),
    [
        (f"sensitivity {F} --limit 0", "findings", False),
        (f"search {F} --max-mb 1", "tried", False),
        (f"search {F} --max-mb 0.001", "tried", True),
    ],
)
def test_the_recipe_has_the_least_int8_that_fits(
    cli: Cli, dense: Path, line: str, rows: str, int8: bool
) -> None:
    assert cli.document(line)[rows]
    assert ("quantize-int8" in (dense / "r.toml").read_text()) == int8


def test_saved_ranges_are_taken_and_stale_ones_refused(cli: Cli, dense: Path) -> None:
    saved = dense / "ranges.json"
    cli.done("calibrate dense.onnx frames --map map.toml -o ranges.json")

    cli.done(f"sensitivity {F} --ranges ranges.json")
    stale = json.loads(saved.read_text()) | {"model": "other"}
    saved.write_text(json.dumps(stale))
    said = cli.refused(f"sensitivity {F} --ranges ranges.json")
    assert "stale: of graph other" in said


@pytest.mark.usefixtures("dense")
def test_search_keeps_size_time_and_energy_at_once(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    battery = SimpleNamespace(j_per_frame=0.5)
    budgets = "me2e_compress.commands.search"
    monkeypatch.setattr(f"{budgets}.open_counter", lambda: None)
    monkeypatch.setattr(
        f"{budgets}.measure_energy", lambda models, *_, **__: {"model": battery}
    )

    found = cli.document(f"search {F} --max-ms 10000 --max-mb 1 --max-joules 1")

    units = [each["unit"] for each in found["budgets"]]
    assert units == ["bytes of weights", "s", "J"]
    assert len(found["tried"][-1]["measured_costs"]) == 3
