"""docs/json.md, from the result classes and the forms of `json_forms.txt`.

python -m benchmarks.tools.json_page
"""

import dataclasses
import inspect
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import me2e_compress
from me2e_compress.base.atomic import write_bytes
from me2e_compress.commands.lint import RuleSummary
from me2e_compress.commands.listing import DoctorResult, ListResult
from me2e_compress.commands.result import Result
from me2e_compress.runtime.latency_trace import TimeShare

PAGE = Path(__file__).parents[2] / "docs" / "json.md"
FORMS = Path(__file__).with_name("json_forms.txt")
NAMED = (DoctorResult, ListResult, RuleSummary, TimeShare)
"""Classes that the forms name beside the public results and what those name."""
HEAD = """\
# What `--json` prints

With `--json` every command prints one document on standard output, strict JSON: a number that is not finite is null. A command that fails exits with 1 and, unless it found something, prints none. In Python: `result.document()`.

`python -m benchmarks.tools.json_page` writes this page from the result classes. Keys may be added; one that goes, or changes its meaning, raises `schema`.

`[T]` is an array of T, `{T}` an object whose keys are names of yours, `{key: T}` one with these keys; `T?` may be null, `key?` may be left out, `+: T` are all keys of T. Capitals begin [objects](#objects); a command's name stands for its document.
"""  # noqa: E501 - a paragraph of the page is one line
_SECTION = re.compile(r"^# (.+)\n", re.MULTILINE)
_FORM = re.compile(r"^with (.+):\n", re.MULTILINE)
_OF_CLASS = re.compile(r"= (\w+)(?: without (.+))?")
_NAME = re.compile(r"[A-Z]\w*")
_ATOMS: Mapping[Any, str] = {
    str: "string",
    bool: "boolean",
    int: "integer",
    float: "number",
    Path: "string",
}
_SMALL = 3
"""Most fields of an object that is written where it is named."""
_OPENING = re.compile(
    r"^(the )?(number|names?|ids?) of (the |its )?|^(whether|the|its) "
)
_FILLER = re.compile(
    r"\b(an?|as|at|by|each|for|has|in|is|its?|of|on|one|per|th(e|at|is|ey)|to|was|were"
    r"|what|which|with)\b"
)
_MAY_BE_INFINITE = {
    *("sqnr_db", "least_db", "most_db", "nodes_db", "error", "compilation_db", "all_db")
}
"""Of a comparison: outputs that are equal, or one that is zero."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A key, or several, their type and what they are."""

    key: str
    type: str
    meaning: str = ""

    def __str__(self) -> str:
        return f"{self.key}: {self.type}"


def page() -> str:
    """Write the page: every command, then every object that one of them names."""
    shown, written_rows = [HEAD], list[Row]()
    for title, text in _forms().items():
        if _is_object(title):
            continue
        shown.append(f"## {title}\n")
        first, *others = _FORM.split(text)
        for when, form in (("", first), *zip(others[::2], others[1::2], strict=True)):
            shown += [f"With {when}:\n"] if when else []
            shown += [_table(_rows(form))] if form else []
            written_rows += _rows(form)
    rows = [
        dataclasses.replace(row, key=f"{name}.{row.key}")
        for name in sorted(_objects(written_rows))
        for row in _rows_of(name)
    ]
    return "\n".join([*shown, "## Objects\n", _table(rows)])


@cache
def _forms() -> dict[str, str]:
    """Read the sections of the forms: commands, and objects that no class describes."""
    _, *parts = _SECTION.split(FORMS.read_text(encoding="utf-8"))
    texts = (f"{each.strip()}\n" for each in parts[1::2])
    return dict(zip(parts[::2], texts, strict=True))


def _is_object(title: str) -> bool:
    return title.isalnum()


@cache
def _classes() -> dict[str, type]:
    """Find the classes by name: those of the forms, and all that their fields name."""
    public = (getattr(me2e_compress, name) for name in vars(me2e_compress)["__all__"])
    given = (get_type_hints(e).get("return") for e in public if inspect.isfunction(e))
    results = (e for e in given if isinstance(e, type) and issubclass(e, Result))
    found, waiting = dict[str, type](), list[Any]([*NAMED, *results])
    while waiting:
        each = waiting.pop()
        waiting += get_args(each)
        is_class = isinstance(each, type) and dataclasses.is_dataclass(each)
        if is_class and each.__name__ not in found:
            found[each.__name__] = each
            waiting += get_type_hints(each).values()
    return found


def _objects(rows: Sequence[Row]) -> set[str]:
    """Find the objects that rows name, and those that these name."""
    found, waiting = set[str](), list(rows)
    while waiting:
        for name in _NAME.findall(waiting.pop().type):
            if name not in found:
                found.add(name)
                waiting += _rows_of(name)
    return found


def _rows(form: str) -> list[Row]:
    """List what a form prints; keys of one type are joined if no more is said."""
    rows = list[Row]()
    for line in form.splitlines():
        if of := _OF_CLASS.fullmatch(line):
            without = {*(of[2] or "").split(", "), *(each.key for each in rows)}
            fields = _fields(_classes()[of[1]])
            rows += [each for each in fields if each.key not in without]
        else:
            key, kind, *said = line.split(" | ")
            rows.append(Row(key, _NAME.sub(lambda name: _object(name[0]), kind), *said))
    silent = dict[str, list[str]]()
    for each in rows:
        if not each.meaning:
            silent.setdefault(each.type, []).append(each.key)
    joined = [Row(", ".join(keys), kind) for kind, keys in silent.items()]
    return [*joined, *(each for each in rows if each.meaning)]


def _rows_of(name: str) -> list[Row]:
    """List the rows of an object: those of its form, else of its class."""
    return _rows(_forms().get(name, f"= {name}"))


def _object(name: str) -> str:
    """Write an object: as a command that prints it, its few fields, or its name."""
    for title, text in _forms().items():
        if text.startswith(f"= {name}\n") and not _is_object(title):
            return title.strip("`")
    rows = _rows_of(name)
    keys = sum(len(each.key.split(", ")) for each in rows)
    if keys > _SMALL or any(each.meaning for each in rows):
        return name
    return "{" + ", ".join(map(str, rows)) + "}"


def _fields(of: type) -> Iterator[Row]:
    """Yield the fields of a class, each with what its docstring says of it."""
    block = (inspect.getdoc(of) or "").partition("Attributes:\n")[2]
    found = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", block, re.MULTILINE)
    meanings = {name: " ".join(said.split()) for name, said in found}
    hints = get_type_hints(of)
    for name in (each.name for each in dataclasses.fields(of)):
        kind = written(hints[name])
        if name in _MAY_BE_INFINITE:
            kind = kind.replace("number", "number?")
        yield Row(name, kind, _brief(name, meanings.get(name, "")))


def _brief(name: str, text: str) -> str:
    """Cut a meaning at its first stop; of what repeats the name nothing is left."""
    first = re.split(r"[.;](?= )|[.;]$|: (?!`)", text, maxsplit=1)[0]
    first = re.sub(r"`{1,2}([^`]+)`{1,2}", r"`\1`", _OPENING.sub("", first))
    words = re.findall(r"[a-z0-9]+", _FILLER.sub("", first))
    new = {each[:4] for each in words} - {each[:4] for each in name.split("_")}
    return first if len(new) > 1 or "`" in first else ""


def written(hint: Any) -> str:
    """Write a Python type as this page does."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint in _ATOMS:
        return _ATOMS[hint]
    if origin is Annotated:
        return written(inner[0])
    if origin in (Union, types.UnionType):
        kinds = [written(each) for each in inner if each is not types.NoneType]
        return " or ".join(kinds) + ("?" if len(kinds) < len(inner) else "")
    if origin is Literal:
        return "string"
    if isinstance(hint, type) and issubclass(hint, Enum):
        return "string"
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _object(hint.__name__)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return f"{{{written(inner[1])}}}"
    if isinstance(origin, type) and issubclass(origin, Sequence):
        elements = dict.fromkeys(written(each) for each in inner if each is not ...)
        return f"[{' or '.join(elements)}]"
    raise TypeError(f"{hint}: how is it printed?")


def _table(rows: Sequence[Row]) -> str:
    lines = [f"`{each}` | {each.meaning}".rstrip(" |") for each in rows]
    return "\n".join(["field | meaning", "-|-", *lines, ""])


def main() -> None:
    write_bytes(PAGE, page().encode())


if __name__ == "__main__":
    main()
