"""A report as one self-contained HTML page, built from a template."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from me2e_compress.display import Table
from me2e_compress.registry.drafts import MARK


@dataclass(frozen=True)
class Drawing:
    """A picture with a caption and words above it, and a note below."""

    picture: Markup
    note: str = ""
    caption: str = ""
    words: str = ""


@dataclass(frozen=True)
class Section:
    """A heading with pictures, their note, tables, and named files to link."""

    title: str
    tables: tuple[Table, ...] = ()
    files: tuple[tuple[str, str], ...] = ()
    drawings: tuple[Drawing, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Page:
    """All that a page shows.

    Attributes:
        findings: What a reader should remember: a name and a sentence.
        made: How it was made, by name.
        variants: Name of each variant, what it was made of, and its sha256.
    """

    title: str
    lede: str
    sections: Sequence[Section]
    made: Sequence[tuple[str, str]]
    variants: Sequence[tuple[str, str, str | None]]
    findings: Sequence[tuple[str, str]] = ()
    findings_note: str = ""
    alerts: Sequence[str] = ()

    def html(self) -> str:
        """Write it as HTML that needs no other file."""
        return template().render(page=self)


def template() -> Template:
    """Return the template of pages, with autoescape on."""
    return Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template("page.html", globals={"mark": MARK})
