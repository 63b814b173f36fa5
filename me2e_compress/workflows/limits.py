"""Numbers that options take; a command's own bounds let NaN pass."""

import math

from me2e_compress.errors import RecipeError


def check_number(option: str, value: float | None, *, zero: bool = False) -> None:
    """Refuse anything but a finite number above 0.

    Args:
        option: its name, for the message.
        value: what was given; None if nothing was.
        zero: whether 0 will do too.

    Raises:
        RecipeError: it is NaN, infinite or too small.
    """
    if value is None or (math.isfinite(value) and (value > 0 or (zero and value == 0))):
        return
    least = "0 or above" if zero else "above 0"
    raise RecipeError(f"{option} is {value:g}: it must be a finite number {least}")


def check_count(option: str, value: int, least: int = 0) -> None:
    """Refuse a count that is too small.

    Raises:
        RecipeError: it is below the least.
    """
    if value < least:
        raise RecipeError(f"{option} is {value}: it must be {least} or more")
