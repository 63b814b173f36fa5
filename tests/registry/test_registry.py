from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import pydantic
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.errors import MissingExtraError, StudyError
from me2e_compress.registry import Option, Registry, describe
from tests.installed import install

GROUP = "me2e_compress.shapes"


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue, or so"


@dataclass(frozen=True)
class Shape:
    name: ClassVar[str] = "shape"


@dataclass(frozen=True)
class Square(Shape):
    """Four sides.

    All of them equal.

    Attributes:
        side: Metres, above
            zero.
        tags: Words.
    """

    name: ClassVar[str] = "square"
    side: Annotated[float, pydantic.Field(gt=0)] = 1.0
    tags: tuple[str, ...] = ()
    count: int = 3
    open: bool = False
    label: str = "none"
    picture: Path | None = None
    limit: int | None = 5
    colour: Colour = Colour.RED
    kind: Literal["a", "b"] = "a"
    area: float = field(default=0.0, init=False)


@dataclass(frozen=True)
class Circle(Shape):
    """Round."""

    name: ClassVar[str] = "circle"
    radius: float


@dataclass(frozen=True)
class Point(Shape):
    """Without size."""

    name: ClassVar[str] = "point"


class Undecorated(Square):
    name = "undecorated"


@dataclass
class Thawed:
    name: ClassVar[str] = "thawed"


@dataclass(frozen=True)
class Misnamed(Shape):
    name: ClassVar[str] = "other"


def __getattr__(name: str) -> object:
    if name == "Broken":
        raise RuntimeError("two\nlines")
    if name == "Lacking":
        raise MissingExtraError("torch", "zoo")
    raise AttributeError(name)


SHAPES: Registry[Shape] = Registry(
    "shape",
    GROUP,
    StudyError,
    {
        "square": f"{__name__}:Square",
        "circle": f"{__name__}:Circle",
        "point": f"{__name__}:Point",
    },
)


@pytest.fixture
def others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three packages: one works, one is broken, two want the same name."""
    here = __name__
    good = {"thawed": f"{here}:Thawed", "misnamed": f"{here}:Misnamed"}
    install(monkeypatch, tmp_path, "good-shapes", GROUP, good)
    bad = {"broken": f"{here}:Broken", "circle": f"{here}:Circle"}
    bad |= {"gone": "no_such_module:Shape", "lacking": f"{here}:Lacking"}
    install(monkeypatch, tmp_path, "bad-shapes", GROUP, bad)
    for package in ("one", "two"):
        entries = {"twice": f"{here}:Point"}
        install(monkeypatch, tmp_path, f"shapes-{package}", GROUP, entries)


def test_a_class_is_found_by_its_name() -> None:
    assert SHAPES.get("square") is Square


def test_a_class_of_another_package_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = Registry[Shape]("shape", GROUP, StudyError, {})
    install(monkeypatch, tmp_path, "p", GROUP, {"square": f"{__name__}:Square"})

    assert ours.parse("square:2") == Square(2.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("square", Square()),
        (" square {} ", Square()),
        ("square:2.5", Square(2.5)),
        ("square{side=2, count=1_000}", Square(2.0, count=1000)),
        ("square{tags=[a, b-c]}", Square(tags=("a", "b-c"))),
        ('square{tags=["a, b", "}"]}', Square(tags=("a, b", "}"))),
        ("square{open=true, limit=null}", Square(open=True, limit=None)),
        ("square{picture=a/b.png}", Square(picture=Path("a/b.png"))),
        ("square{label=x{y=[1, 2]}}", Square(label="x{y=[1, 2]}")),
        ('square{label=x{y="}"}}', Square(label='x{y="}"}')),
        ("square{label=fps:10,count=1}", Square(label="fps:10", count=1)),
        ('square{colour="blue, or so"}', Square(colour=Colour.BLUE)),
        ("circle:1e-3", Circle(0.001)),
    ],
)
def test_text_becomes_an_item(text: str, expected: Shape) -> None:
    assert SHAPES.parse(text) == expected


def test_what_follows_a_colon_is_taken_as_it_stands() -> None:
    ours = Registry[Shape]("shape", GROUP, StudyError, {"file": f"{__name__}:File"})

    assert ours.parse("file:a, {b}: c=[d]") == File(Path("a, {b}: c=[d]"))


@dataclass(frozen=True)
class File(Shape):
    """A file."""

    name: ClassVar[str] = "file"
    path: Path


def test_items_are_parted_by_commas() -> None:
    text = "square{tags=[a,b]}, circle:2,point"
    assert SHAPES.parse_all(text) == (Square(tags=("a", "b")), Circle(2.0), Point())


SHORT = st.text(max_size=6)


@given(
    st.builds(
        Square,
        side=st.floats(min_value=0, exclude_min=True),
        tags=st.lists(SHORT, max_size=2).map(tuple),
        count=st.integers(-(2**70), 2**70),
        open=st.booleans(),
        label=SHORT,
        picture=st.none() | SHORT.map(Path),
        limit=st.none() | st.integers(),
        colour=st.sampled_from(Colour),
        kind=st.sampled_from(["a", "b"]),
    )
)
def test_text_and_items_are_the_same_thing(square: Square) -> None:
    assert SHAPES.parse_all(SHAPES.text_all([square, square])) == (square, square)


@given(st.floats(allow_nan=False), st.booleans())
def test_a_single_number_stands_behind_a_colon(radius: float, defaults: bool) -> None:
    text = SHAPES.text(Circle(radius), defaults=defaults)

    assert text.startswith("circle:")
    assert SHAPES.parse_all(text) == (SHAPES.parse(text),) == (Circle(radius),)


def test_defaults_are_written_where_they_are_asked_for() -> None:
    assert SHAPES.text(Square()) == "square"
    assert SHAPES.text(Square(), defaults=True) == (
        'square{side=1.0, tags=[], count=3, open=false, label="none", picture=null,'
        ' limit=5, colour="red", kind="a"}'
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sqare", "no shape 'sqare'; there are square, circle, point"),
        ("square{sides=3}", "square has no option 'sides'; it has side, tags, count"),
        ("square{area=3.0}", "square has no option 'area'"),
        ("point{x=3}", "point has no option 'x'; it has none"),
        ("point:3", "point takes no value, found '3'"),
        ("circle", "circle needs the option radius"),
        ("circle:", "a value is expected behind circle:"),
        ("square:wide", "square: side: Input should be a valid number"),
        ("square:0", "square: side: Input should be greater than 0"),
        ("square{tags=a}", "square: tags: Input should be a valid tuple"),
        ("square{kind=c}", "square: kind: Input should be 'a' or 'b'"),
        ("square{tags=[}", "from '}' on: a value is expected"),
        ("square{tags=[a b]}", r"from 'b\]}' on: a comma or \] is expected"),
        ("square{count=3", "to the end: a comma or } is expected"),
        ("square{label=x{y=1}", "to the end: a comma or } is expected"),
        ("square{label=x{y=1", "from '{y=1' on: a closing } is missing"),
        ("square{count=1, count=2}", "option count is given twice"),
        ("square{3}", "from '3}' on: option=value is expected"),
        (r'square{label="\x"}', "is not a JSON string"),
        ("square{}, point", "from ', point' on: a comma or the end is expected"),
        ("3", "no shape '3'; there are square"),
        ("square 3", "no shape 'square 3'; there are square"),
        ("", "no shape ''; there are square"),
    ],
)
def test_bad_text_names_the_culprit_on_one_line(text: str, message: str) -> None:
    with pytest.raises(StudyError, match=message) as caught:
        SHAPES.parse(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("broken", r"'broken' of bad-shapes 1.0 .*imported: RuntimeError: two lines"),
        ("gone", r"'gone' of bad-shapes 1.0 \(no_such_module:Shape\) cannot be impor"),
        ("thawed", "'thawed' of good-shapes 1.0 .* is not a frozen dataclass"),
        ("misnamed", "'misnamed' of good-shapes 1.0 .* calls itself 'other'"),
        ("circle", "'circle' is claimed by me2e-compress and bad-shapes 1.0: uninst"),
        ("twice", "'twice' is claimed by shapes-(one|two) 1.0 and shapes-"),
    ],
)
@pytest.mark.usefixtures("others")
def test_an_entry_that_cannot_be_used_is_named(name: str, message: str) -> None:
    with pytest.raises(StudyError, match=message) as caught:
        SHAPES.get(name)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("others")
def test_what_needs_an_extra_says_which() -> None:
    with pytest.raises(MissingExtraError, match=r"me2e-compress\[zoo\]"):
        SHAPES.get("lacking")


@pytest.mark.usefixtures("others")
def test_the_rest_works_beside_broken_entries() -> None:
    assert SHAPES.parse_all("square,point") == (Square(), Point())
    assert SHAPES.usable() == ("square", "point")


@pytest.mark.usefixtures("others")
def test_every_entry_is_listed_with_its_trouble() -> None:
    entries = {entry.name: entry for entry in describe(SHAPES)}

    assert list(entries) == [
        *("square", "circle", "point"),
        *("broken", "gone", "lacking", "misnamed", "thawed", "twice"),
    ]
    assert entries["square"].error == ""
    assert "RuntimeError" in entries["broken"].error
    assert entries["circle"].source == "me2e-compress and bad-shapes 1.0"


def test_an_undecorated_class_has_no_options_of_its_own() -> None:
    ours = Registry[Shape]("s", "", StudyError, {"u": f"{__name__}:Undecorated"})

    with pytest.raises(StudyError, match="is not a frozen dataclass"):
        ours.get("u")


def test_an_entry_is_described() -> None:
    square = describe(SHAPES)[0]

    assert (square.name, square.source, square.doc) == (
        *("square", "me2e-compress"),
        "Four sides.",
    )
    assert [option.name for option in square.options][:3] == ["side", "tags", "count"]
    assert square.options[1:3] == (
        Option("tags", "tuple[str, ...]", "[]", "Words."),
        Option("count", "int", "3", ""),
    )
    assert square.options[0].doc == "Metres, above zero."
    assert square.options[5].type == "Path | None"


def test_what_must_be_given_has_no_default() -> None:
    (radius,) = describe(SHAPES)[1].options
    assert radius == Option("radius", "float", None, "")
