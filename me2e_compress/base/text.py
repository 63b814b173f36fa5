"""Items as text: ``name``, ``name{option=value, ...}`` or ``name:value``.

A value is a number, ``true`` or ``false``, ``null``, a list ``[a, b]``, a mapping
``{a=1, "b c"=2}``, a word, or a string in double quotes with JSON's escapes. A word
needs no quotes, and may have braces of its own:
``quantize-int8{rules=paper{attention_limit=256}}``.
"""

import dataclasses
import json
import re
from collections.abc import Mapping
from typing import NoReturn

_NAME = re.compile(r"[A-Za-z][\w.-]*", re.ASCII)
_BEGINNING = re.compile(rf"{_NAME.pattern}(?=[:{{]|\Z)", re.ASCII)
_KEY = re.compile(r"\w+(?=\s*=)")
_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"')
_WORD = re.compile(r'[^\s\[\]{},="]+')
_SHORT = re.compile(r"[^\s\[\]{},]+")
_SPACE = re.compile(r"\s*")
_NESTING = re.compile(r'"(?:[^"\\]|\\.)*"|[{}]')
_INTEGER = re.compile(r"[+-]?[0-9]+(_[0-9]+)*")
_FLOAT = re.compile(r"[+-]?[0-9]+(_[0-9]+)*(\.[0-9]+)?([eE][+-]?[0-9]+)?")
_LITERALS = {"true": True, "false": False, "null": None}
_MOST_QUOTED = 40
# Most nested lists; our own options need one
_MOST_NESTING = 32
# The most characters of a number: the largest float64 has 309 digits.
_MOST_DIGITS = 400


class TextError(ValueError):
    """A text does not follow the grammar; the message says from where on."""


@dataclasses.dataclass(frozen=True)
class ParsedItem:
    """A name, the options in braces after it, and the value after a colon.

    ``numbers`` holds numbers as they are written: version 10.10 is not version 10.1.
    """

    name: str
    options: Mapping[str, object] = dataclasses.field(default_factory=dict)
    value: str | None = None
    numbers: Mapping[str, str] = dataclasses.field(default_factory=dict)


def name_in(text: str) -> str:
    """Return the name that a text begins with, empty if there is none."""
    # A colon, a brace or the end of the text must follow it
    name = _BEGINNING.match(text.strip())
    return "" if name is None else name.group()


def read_one(text: str) -> ParsedItem:
    """Read one item; what follows its colon is taken as it stands; else a TextError."""
    name, colon, value = text.strip().partition(":")
    if colon and value and name == name_in(text):
        return ParsedItem(name, value=value)
    reader = _Reader(text)
    item = reader.item()
    reader.end()
    return item


def read_all(text: str) -> tuple[ParsedItem, ...]:
    """Read items parted by commas, at least one; anything else is a TextError."""
    reader = _Reader(text)
    items = [reader.item()]
    while reader.take(","):
        items.append(reader.item())
    reader.end()
    return tuple(items)


def write_item(name: str, options: Mapping[str, object], *, short: bool = False) -> str:
    """Write an item so that it is read back; ``short`` writes ``name:number``."""
    if not options:
        return name
    values = list(options.values())
    if short and len(values) == 1 and type(values[0]) in (int, float):
        return f"{name}:{str(values[0]).removesuffix('.0')}"
    inner = ", ".join(f"{key}={write_value(value)}" for key, value in options.items())
    return f"{name}{{{inner}}}"


def write_value(value: object) -> str:
    """Write the value of an option: a number, a list, a mapping, or else a string."""
    # A dataclass is a mapping of its fields, those at their default left out, unless it
    # has a text of its own
    own = type(value).__str__ is not object.__str__
    if dataclasses.is_dataclass(value) and not isinstance(value, type) and not own:
        fields = [
            (f.name, getattr(value, f.name), f) for f in dataclasses.fields(value)
        ]
        return write_value(
            {name: item for name, item, f in fields if item != f.default}
        )
    if isinstance(value, tuple | list):
        return "[" + ", ".join(write_value(item) for item in value) + "]"
    if isinstance(value, Mapping):
        pairs = (f"{_key(name)}={write_value(item)}" for name, item in value.items())
        return "{" + ", ".join(pairs) + "}"
    if value is None or isinstance(value, bool | int | float | str):
        return json.dumps(value)
    return json.dumps(str(value))


def _key(name: object) -> str:
    """Write the name of a mapping's value, in quotes if it is no plain word."""
    return str(name) if re.fullmatch(r"\w+", str(name)) else json.dumps(str(name))


class _Reader:
    """A text and how far it is read."""

    def __init__(self, text: str) -> None:
        self.text, self.at, self.depth = text, 0, 0

    def item(self) -> ParsedItem:
        name = self.expect(_NAME, "a name is expected")
        # name:value
        if self.take(":"):
            value = self.expect(_SHORT, f"a value is expected behind {name}:")
            return ParsedItem(name, value=value)
        # name{option=value, ...}, or the name alone
        numbers = dict[str, str]()
        options = self.options(numbers) if self.take("{") else {}
        return ParsedItem(name, options, numbers=numbers)

    def options(self, numbers: dict[str, str] | None = None) -> dict[str, object]:
        options: dict[str, object] = {}
        while not self.take("}"):
            if options and not self.take(","):
                self.fail("a comma or } is expected")
            name = self.key()
            if name in options:
                self.fail(f"option {name} is given twice")
            if not self.take("="):
                self.fail("option=value is expected")
            begin = self.at
            options[name] = value = self.value()
            if numbers is not None and isinstance(value, int | float):
                numbers[name] = self.text[begin : self.at].strip()
        return options

    def key(self) -> str:
        if name := self.match(_KEY):
            return name
        return self.string(self.expect(_QUOTED, "option=value is expected"))

    def value(self) -> object:
        # Lists, mappings and strings by their first mark
        if self.take("["):
            return self.sequence()
        if self.take("{"):
            return self.options()
        if quoted := self.match(_QUOTED):
            return self.string(quoted)
        # A word with braces is an item of its own, which its owner reads
        word = self.expect(_WORD, "a value is expected")
        if self.text.startswith("{", self.at):
            return word + self.braces()
        if len(word) > _MOST_DIGITS and word[:9].strip("+-_").isdecimal():
            self.fail(f"a number of more than {_MOST_DIGITS} digits")
        # A truth value, null or a number; else a word
        if word in _LITERALS:
            return _LITERALS[word]
        if _INTEGER.fullmatch(word):
            return int(word)
        return float(word) if _FLOAT.fullmatch(word) else word

    def sequence(self) -> list[object]:
        values: list[object] = []
        self.depth += 1
        if self.depth > _MOST_NESTING:
            self.fail("lists are nested too deeply")
        while not self.take("]"):
            if values and not self.take(","):
                self.fail("a comma or ] is expected")
            values.append(self.value())
        self.depth -= 1
        return values

    def string(self, quoted: str) -> str:
        try:
            return str(json.loads(quoted, strict=False))
        except json.JSONDecodeError as error:
            self.fail(f"{quoted} is not a JSON string ({error.msg})")

    def braces(self) -> str:
        """Return the text from one brace to the one that closes it."""
        start, depth = self.at, 0
        for token in _NESTING.finditer(self.text, start):
            depth += {"{": 1, "}": -1}.get(token.group(), 0)
            if depth == 0:
                self.at = token.end()
                return self.text[start : self.at]
        self.fail("a closing } is missing")

    def end(self) -> None:
        self.match(_SPACE)
        if self.at < len(self.text):
            self.fail("a comma or the end is expected")

    def take(self, mark: str) -> bool:
        """Consume a mark and the space before it if it comes next; return whether."""
        self.match(_SPACE)
        there = self.text.startswith(mark, self.at)
        self.at += len(mark) * there
        return there

    def match(self, pattern: re.Pattern[str]) -> str | None:
        """Consume and return what matches next, after space; None if nothing does."""
        space = _SPACE.match(self.text, self.at)
        match = pattern.match(self.text, space.end() if space else self.at)
        if match is None:
            return None
        self.at = match.end()
        return match.group()

    def expect(self, pattern: re.Pattern[str], otherwise: str) -> str:
        """Consume and return what matches next; a TextError if nothing does."""
        text = self.match(pattern)
        if text is None:
            self.fail(otherwise)
        return text

    def fail(self, expected: str) -> NoReturn:
        rest = self.text[self.at :]
        position = f"from {rest[:_MOST_QUOTED]!r} on" if rest else "to the end"
        whole = self.text if len(self.text) <= 200 else f"{self.text[:200]}..."
        raise TextError(f"cannot read {whole!r} {position}: {expected}")
