"""What a terminal of 80 columns shows: no name is broken."""

import pytest

from me2e_compress.cli import console
from me2e_compress.cli.console import print_table
from me2e_compress.display import Cell, Table, table

NODE = "/planner/agent_layer/cross_attn/value/MatMul"
COLUMNS = ("module", "node", "op", "rule", "why")


def printed(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    width: int,
    *row: str,
) -> list[str]:
    monkeypatch.setattr(console.console, "width", width)
    print_table(table("Nodes", COLUMNS, [row], words=len(row)))
    return [line.rstrip() for line in capsys.readouterr().out.splitlines()]


def test_words_that_fit_stand_in_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = ("planner", NODE, "MatMul", "layer", "a product")
    lines = printed(capsys, monkeypatch, 100, *row)

    assert lines[1].split() == [
        "module",
        "┃",
        "node",
        "┃",
        "op",
        "┃",
        "rule",
        "┃",
        "why",
    ]
    assert all(NODE in line for line in lines[3:4])


def test_only_long_sentences_wrap(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = ("driving score", "72.22", "43.93 to 100.00", "5", "not measured: " * 4)
    lines = printed(capsys, monkeypatch, 80, *row)

    assert any("driving score" in each and "43.93 to 100.00" in each for each in lines)


def test_words_that_do_not_fit_stand_below_each_other(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = (NODE, "planner", "MatMul", f"as_{NODE}", "")
    lines = printed(capsys, monkeypatch, 80, *row)

    assert lines == [
        "Nodes",
        NODE,
        "    node: planner",
        "    op: MatMul",
        f"    rule: as_{NODE}",
    ]


def test_sentences_wrap_between_words(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = ("planner", NODE, "MatMul", "layer", "int8 " * 20)
    lines = printed(capsys, monkeypatch, 80, *row)

    assert all(len(line) <= 80 for line in lines)
    assert sum(line.count("int8") for line in lines) == 20
    assert any(NODE in line for line in lines)


def scores(count: int) -> Table:
    row = (Cell("full"), *[Cell("+13.4", "-0.3 to +40.6")] * count)
    columns = ("variant", *[f"score {at}" for at in range(count)])
    return Table("Scores", columns, (row,), "Each with its interval.")


def test_intervals_that_fit_stand_on_a_narrow_terminal_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """+13.4 points stood there without the interval that the caption promises."""
    monkeypatch.setattr(console.console, "width", 80)

    print_table(scores(2))
    assert "-0.3 to +40.6" in capsys.readouterr().out

    print_table(scores(6))
    said = capsys.readouterr().out
    assert "-0.3" not in said
    assert "Intervals: in a terminal of 120 columns." in said
