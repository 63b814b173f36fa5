"""Results and tables are one line, text and Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass

from me2e_compress.base.display import Table, table
from me2e_compress.commands.result import Result

NAMES = ("<b>", "a & b")


@dataclass(frozen=True, repr=False)
class Found(Result):
    names: Sequence[str] = NAMES

    @property
    def headline(self) -> str:
        return f"{len(self.names)} <names>"

    def tables(self) -> tuple[Table, ...]:
        rows = [(name, str(len(name))) for name in self.names]
        return (table("Names & sizes", ("name", "size"), rows),)


def test_a_result_is_one_line() -> None:
    assert repr(Found()) == "<Found: 2 <names>>"


NASTY = "a\x1b[31m[red]|<b>\n\u202eb\udcff"


def test_names_do_not_steer_a_terminal_and_are_no_markup_in_markdown() -> None:
    found = table("t" + NASTY, ["name"], [[NASTY]], note="one\ntwo\x07 < b")
    shown, written = found.escape_controls(), found.markdown()

    assert shown.rows[0][0].text == r"a\x1b[31m[red]|<b>\n\u202eb\udcff"
    assert shown.title == r"ta\x1b[31m[red]|<b>\n\u202eb\udcff"
    assert shown.note == "one\ntwo\\x07 < b"
    assert written.startswith(r"**ta\x1b[31m[red]\|&lt;b&gt;")
    assert r"| a\x1b[31m[red]\|&lt;b&gt; \u202eb\udcff |" in written
    assert r"two\x07 &lt; b" in written
