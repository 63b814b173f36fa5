"""The code blocks of the documents."""

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "third_party"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
WRITING = tuple(page for page in PAGES if page.name.startswith("writing-"))

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_HEAD = re.compile(r"# (me2e_example/\w+\.py)\n")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language (empty without one) and its text."""

    language: str
    text: str

    @property
    def file(self) -> str | None:
        """The file of the example package that the block says it is."""
        head = _HEAD.match(self.text)
        return head[1] if head else None

    @property
    def body(self) -> str:
        """The text without the line that names the file."""
        return _HEAD.sub("", self.text, count=1)


def blocks(page: Path, *languages: str) -> list[Block]:
    found = _BLOCK.findall(page.read_text(encoding="utf-8"))
    return [Block(*each) for each in found if not languages or each[0] in languages]
