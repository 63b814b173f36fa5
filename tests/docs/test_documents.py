"""Every command that prints a document has a section in docs/json.md, and only those.

The documents themselves are held against the page where the commands are tested.
"""

from benchmarks.tools.json_page import page
from me2e_compress.cli.app import COMMANDS
from tests.docs.documents import EVERY, PAGE, sections


def test_the_page_is_what_the_classes_say() -> None:
    assert PAGE.read_text("utf-8") == page()


def test_the_page_has_no_other_section() -> None:
    assert set(sections()) == {EVERY, *COMMANDS}
