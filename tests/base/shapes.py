"""A registry of shapes that are dataclasses with options of every type."""

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import pydantic

from me2e_compress.base.errors import StudyError
from me2e_compress.base.registry import Registry

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
