from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.base.errors import StudyError
from me2e_compress.base.registry import Option, Registry, describe
from tests.base.shapes import GROUP, SHAPES, Circle, Colour, Point, Shape, Square


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
        ("square{label=10.10, side=2}", Square(2.0, label="10.10")),
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
        ("square{tags=a}", r"square: tags: Input should be a list, as \[a, b\]"),
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
    (radius,) = describe(SHAPES)[1].options
    assert radius == Option("radius", "float", None, "")  # it must be given
