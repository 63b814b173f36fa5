"""Items of other packages: found by name, or listed with what is wrong with them."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.base.errors import MissingExtraError, StudyError
from me2e_compress.base.registry import Registry, describe
from tests.base.shapes import GROUP, SHAPES, Point, Shape, Square
from tests.support.installed import install


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
        raise MissingExtraError("ray", "ray")
    raise AttributeError(name)


@pytest.fixture
def others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three packages: one works, one is broken, two want the same name."""
    here, there = __name__, Shape.__module__
    classes = (Thawed, Misnamed, Undecorated)
    good = {each.__name__.lower(): f"{here}:{each.__name__}" for each in classes}
    install(monkeypatch, tmp_path, "good-shapes", GROUP, good)
    bad = {"broken": f"{here}:Broken", "circle": f"{there}:Circle"}
    bad |= {"gone": "no_such_module:Shape", "lacking": f"{here}:Lacking"}
    install(monkeypatch, tmp_path, "bad-shapes", GROUP, bad)
    for package in ("one", "two"):
        entries = {"twice": f"{there}:Point"}
        install(monkeypatch, tmp_path, f"shapes-{package}", GROUP, entries)


def test_a_class_of_another_package_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = Registry[Shape]("shape", GROUP, StudyError, {})
    entry = {"square": f"{Square.__module__}:Square"}
    install(monkeypatch, tmp_path, "p", GROUP, entry)

    assert ours.parse("square:2") == Square(2.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("broken", r"'broken' of bad-shapes 1.0 .*imported: RuntimeError: two lines"),
        ("gone", r"'gone' of bad-shapes 1.0 \(no_such_module:Shape\) cannot be impor"),
        ("thawed", "'thawed' of good-shapes 1.0 .* is not a frozen dataclass"),
        ("misnamed", "'misnamed' of good-shapes 1.0 .* calls itself 'other'"),
        ("undecorated", "'undecorated' of good-shapes 1.0 .* is not a frozen datacl"),
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
    with pytest.raises(MissingExtraError, match=r"me2e-compress\[ray\]"):
        SHAPES.get("lacking")


@pytest.mark.usefixtures("others")
def test_every_entry_is_listed_with_its_trouble() -> None:
    entries = {entry.name: entry for entry in describe(SHAPES)}

    assert list(entries) == [
        *("square", "circle", "point"),
        *("broken", "gone", "lacking", "misnamed", "thawed", "twice"),
        "undecorated",
    ]
    assert SHAPES.parse_all("square,point") == (Square(), Point())
    assert SHAPES.usable() == ("square", "point")
    assert entries["square"].error == ""
    assert "RuntimeError" in entries["broken"].error
    assert entries["circle"].source == "me2e-compress and bad-shapes 1.0"
