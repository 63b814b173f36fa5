"""Shapes of which one dimension may be open: so many times the batch."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias


@dataclasses.dataclass(frozen=True)
class Open:
    """A multiple of the batch, whose size only the inputs tell."""

    times: int = 1


Dim: TypeAlias = int | Open
Shape: TypeAlias = tuple[Dim, ...]


def product(dims: Iterable[Dim]) -> Dim:
    """Multiply dimensions, of which at most one is open."""
    listed = list(dims)
    factor = math.prod(each for each in listed if isinstance(each, int))
    opened = [each for each in listed if isinstance(each, Open)]
    if not opened:
        return factor
    (one,) = opened
    return Open(one.times * factor)


def is_static(shape: Iterable[Dim]) -> bool:
    return all(isinstance(each, int) for each in shape)


def sizes(shape: Iterable[Dim]) -> tuple[int, ...]:
    """Return a shape that has no open dimension."""
    found = [each for each in shape if isinstance(each, int)]
    assert is_static(shape)
    return tuple(found)


def elements(shape: Sequence[Dim], batch: int = 3) -> int:
    """Count the elements at some size of the batch."""
    return math.prod(concrete(shape, batch))


def concrete(shape: Iterable[Dim], batch: int) -> tuple[int, ...]:
    """Put a size in the place of the batch."""
    return tuple(
        each if isinstance(each, int) else each.times * batch for each in shape
    )


def broadcast(*shapes: Sequence[Dim]) -> Shape:
    """Return the shape that these are broadcast to."""
    rank = max(map(len, shapes))
    result: list[Dim] = []
    for axis in range(-rank, 0):
        found = {shape[axis] for shape in shapes if len(shape) >= -axis} - {1}
        if len(found) > 1:
            raise ValueError(f"{shapes} are not broadcast")
        result.append(next(iter(found), 1))
    return tuple(result)


def fits(small: Sequence[Dim], large: Sequence[Dim]) -> bool:
    """Say whether a shape is broadcast to another."""
    try:
        return broadcast(small, large) == tuple(large)
    except ValueError:
        return False
