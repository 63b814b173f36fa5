"""Results show themselves: in a notebook, as a data frame, in one line."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import pytest

from me2e_compress.errors import MissingPackageError
from me2e_compress.workflows.result import MOST_ROWS, Result, Table, table

NAMES = ("<b>", "a & b")


@dataclass(frozen=True, repr=False)
class Found(Result):
    names: Sequence[str] = NAMES
    shown: bool = True

    @property
    def headline(self) -> str:
        return f"{len(self.names)} <names>"

    def tables(self) -> tuple[Table, ...]:
        rows = [(name, str(len(name))) for name in self.names]
        made = table("Names & sizes", ("name", "size"), rows, "first\n<second>")
        return (made,) if self.shown else ()

    def records(self) -> list[dict[str, object]]:
        return [{"name": name, "size": len(name)} for name in self.names]

    def to_json(self) -> object:
        return self.records()


def test_a_notebook_shows_tables_and_line_with_every_name_escaped() -> None:
    shown = Found()._repr_html_()

    assert "<b>" not in shown
    assert "&lt;b&gt;" in shown
    assert "a &amp; b" in shown
    assert "Names &amp; sizes" in shown
    assert "first<br>&lt;second&gt;" in shown
    assert "2 &lt;names&gt;" in shown


def test_words_stand_left_and_numbers_right() -> None:
    shown = Found()._repr_html_()

    assert '<td style="text-align:left">&lt;b&gt;</td>' in shown
    assert '<td style="text-align:right">3</td>' in shown


def test_a_long_table_says_how_much_it_leaves_out() -> None:
    shown = Found(tuple(map(str, range(MOST_ROWS + 5))))._repr_html_()

    assert shown.count("<tr>") == MOST_ROWS + 2
    assert '<td colspan="2">5 more</td>' in shown


def test_records_are_shown_where_there_is_no_table() -> None:
    assert "<th" in Found(shown=False)._repr_html_()
    assert Found((), shown=False)._repr_html_() == "<p>0 &lt;names&gt;</p>"


def test_records_become_a_data_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = ModuleType("pandas")
    pandas.DataFrame = list  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pandas", pandas)

    assert Found().to_pandas() == Found().records()


def test_without_pandas_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)

    with pytest.raises(MissingPackageError) as caught:
        Found().to_pandas()
    assert str(caught.value) == "pandas is not installed: pip install pandas"


def test_a_result_is_one_line() -> None:
    assert repr(Found()) == "<Found: 2 <names>>"


def test_markdown_keeps_its_columns() -> None:
    (made,) = Found(("a|b",)).tables()

    assert "| a\\|b | 3 |" in made.markdown()


NASTY = "a\x1b[31m[red]|<b>\n\u202eb\udcff"


def test_names_do_not_steer_a_terminal() -> None:
    shown = table("t" + NASTY, ["name"], [[NASTY]], note="one\ntwo\x07").printable()

    assert shown.rows[0][0].text == r"a\x1b[31m[red]|<b>\n\u202eb\udcff"
    assert shown.title == r"ta\x1b[31m[red]|<b>\n\u202eb\udcff"
    assert shown.note == "one\ntwo\\x07"


def test_names_are_no_markup_in_markdown() -> None:
    written = table("<i>", ["name"], [[NASTY]], note="a < b").markdown()

    assert written.startswith("**&lt;i&gt;**")
    assert r"| a\x1b[31m[red]\|&lt;b&gt; \u202eb\udcff |" in written
    assert "a &lt; b" in written
