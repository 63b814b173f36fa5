"""Broken text files: JSON and TOML changed in one place, and texts that are neither."""

import json
import random
import re
from collections.abc import Callable, Iterator
from typing import Any

DEEP = 100_000
HUGE = "9" * 5000
MARKUP = "[red]a[/]b\x1b[31m[/nope]\n<script>|\u202e"

BAD_JSON = (
    "null", "true", "-1", "0", "1e308", "1e999", "NaN", "-Infinity", HUGE, '""', "[]",
    "{}", '"a\\u0000b"', '"\\ud800"', json.dumps(MARKUP), '"../../x"', "[[]]",
    '{"a": 1}', "0.5", "12345678901234567890123", "[null]", f'"{"y" * 5000}"',
)  # fmt: skip
"""Values as JSON text; NaN, infinities and lone surrogates too, which Python reads."""

BAD_TOML = (
    "true", "-1", "0", "1e308", "nan", "-inf", HUGE, '""', "[]", "{}",
    '"a\\u0000b"', '"\\u001b[31m[/red]"', '"[red]x[/]"', '"../../x"', "[[]]",
    "{a = 1}", "0.5", "1979-05-27", "12345678901234567890123", "[1]", '["["]', '"***"',
)  # fmt: skip

PLACE = "\ue000"
"""Stands in a text where a value is to be written."""


def neither() -> Iterator[tuple[str, bytes]]:
    """Yield files that are no text of any format."""
    yield from {
        "empty": b"",
        "blank": b"\n \n",
        "zeros": bytes(100),
        "not-utf-8": b"\xff\xfe\x80\x81",
        "utf-16": "{}".encode("utf-16"),
        "bom": b"\xef\xbb\xbf{}",
        "deep-list": b"[" * DEEP,
        "deep-object": b'{"a":' * DEEP,
        "deep-toml": b"a = " + b"[" * DEEP,
        "deep-inline": b"a = " + b"{a = " * DEEP,
        "huge": HUGE.encode(),
        "huge-toml": b"a = " + HUGE.encode(),
        "list": b"[]",
        "string": b'"a"',
        "null": b"null",
        "nan": b"NaN",
        "surrogate": b'"\\ud800"',
        "markup": MARKUP.encode(),
    }.items()


def places(record: Any) -> Iterator[str]:
    """Yield a JSON document once for every value in it, `PLACE` in its stead."""
    yield from (json.dumps(each) for each in _holes(record))


def _holes(value: Any) -> Iterator[Any]:
    yield PLACE
    if isinstance(value, dict):
        for key in value:
            yield from ({**value, key: hole} for hole in _holes(value[key]))
            yield {k: v for k, v in value.items() if k != key}
        yield {**value, PLACE: 1}
    elif isinstance(value, list) and value:
        yield from ([hole, *value[1:]] for hole in _holes(value[0]))
        yield [*value, value[0]]


def broken_json(text: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Draw documents that differ from a good one in one value, key or byte."""
    draw = random.Random(0)
    holes = [hole.replace('"\\ue000"', PLACE) for hole in places(json.loads(text))]
    for each in range(count):
        hole, bad = draw.choice(holes), draw.choice(BAD_JSON)
        yield f"json-{each}", _bitten(hole.replace(PLACE, bad, 1), draw)


_VALUE = re.compile(r"(?<== ).+$|(?<=\[)[\w.-]+(?=\])", re.MULTILINE)


def broken_toml(text: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Draw files that differ from a good one in one value, line or byte."""
    draw = random.Random(0)
    values = list(_VALUE.finditer(text))
    changes: tuple[Callable[[], str], ...] = (
        lambda: _at(text, draw.choice(values), draw.choice(BAD_TOML)),
        lambda: _at(text, draw.choice(values), draw.choice(BAD_TOML)),
        lambda: _at(text, draw.choice(values), draw.choice(BAD_TOML)),
        lambda: text + "\n" + draw.choice(text.splitlines()),
        lambda: text + f"\nunknown = {draw.choice(BAD_TOML)}",
        lambda: text.replace(draw.choice(text.splitlines()), ""),
        lambda: text.replace(draw.choice(values).group(), "'" * 3, 1),
    )
    for each in range(count):
        changed = draw.choice(changes)()
        yield f"toml-{each}", _bitten(changed, draw)


def _at(text: str, found: re.Match[str], bad: str) -> str:
    return text[: found.start()] + bad + text[found.end() :]


def _bitten(text: str, draw: random.Random) -> bytes:
    """Lose or change a byte now and then."""
    content = text.encode("utf-8", "surrogatepass")
    if draw.random() < 0.15 and content:
        at = draw.randrange(len(content))
        return content[:at] + bytes([draw.randrange(256)]) + content[at + 1 :]
    return content[: draw.randrange(len(content))] if draw.random() < 0.05 else content


PIPELINES = (
    "", ",", "{", "}", "[", ":", "fold-constants,", ",fold-constants",
    "fold-constants{", "fold-constants{}}", "fold-constants:1",
    "fold-constants{through_compute=" + "[" * DEEP,
    "fold-constants{through_compute=" + "[" * DEEP + "]" * DEEP + "}",
    "quantize-int8{rules=" + "a{" * DEEP + "}" * DEEP + "}",
    "fold-constants{through_compute=" + HUGE + "}",
    "fold-constants{limit_bytes=" + HUGE + "}",
    "fold-constants{limit_bytes=1e308}", "fold-constants{limit_bytes=nan}",
    "fold-constants{limit_bytes=-1}", 'ablate-modules{drop=["\\ud800"]}',
    'ablate-modules{drop=["a\\u0000b"]}', "ablate-modules{drop=[[[]]]}",
    "ablate-modules{drop=null}", "ablate-modules{keep=[" + '"*",' * 999 + '"*"]}',
    "ablate-modules{drop=[head], keep=[***]}", "quantize-int8{scheme=full}",
    "quantize-int8{scheme=[red]}", "quantize-int8{rules=paper{attention_limit=nan}}",
    "quantize-int8{rules=paper{attention_limit=" + HUGE + "}}",
    "quantize-int8{ranges=../../..}", 'quantize-int8{ranges="a\\u0000b"}',
    "quantize-int8{method=percentile:nan}", "quantize-int8{method=percentile:1e308}",
    "quantize-int8{method=percentile:" + HUGE + "}",
    "quantize-int8{overrides=/dev/null}", "lower-int8", "lower-int8,lower-int8",
    "surgeon-function{function=os:system}", "surgeon-function", "\x1b[31m[/red]",
    "fold-with-onnxsim{timeout_s=-1}", "fold-with-onnxsim{timeout_s=nan}",
    "import-normalize{map=[red]}", "import-normalize{map=/}",
)  # fmt: skip
"""Texts for ``--passes``."""
