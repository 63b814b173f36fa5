"""Check what all items of registries have in common."""

import re
from typing import TypeVar

from me2e_compress.base.errors import VerificationError
from me2e_compress.base.registry import (
    NamedItem,
    Registry,
    is_frozen_dataclass,
    options_of,
)

_KEBAB = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")

T = TypeVar("T", bound=NamedItem)


def require(holds: object, message: str) -> None:
    """Raise a VerificationError with a message unless something holds."""
    if not holds:
        raise VerificationError(message)


def check_class(item: NamedItem) -> None:
    """Check that an item is of a frozen dataclass with a name-like-this."""
    cls = type(item)
    require(is_frozen_dataclass(cls), f"{cls.__name__} is not a frozen dataclass")
    require(_KEBAB.fullmatch(item.name), f"{item.name!r} is not a name-like-this")


def check_form(item: T, registry: Registry[T]) -> None:
    """Check that an item is a frozen dataclass that text can represent.

    It must have a name-like-this and a docstring that describes every option, and its
    text must build an equal item. ``item`` is a pass, rule, observer, driver, ..., and
    need not be installed; ``registry`` is that of its kind, e.g.
    ``calibration.observers.OBSERVERS``.

    Raises:
        VerificationError: it is not; the message says why.
    """
    check_class(item)
    cls = type(item)
    made = f"{cls.__name__}("  # how the docstring begins that dataclass makes
    own = cls.__doc__ is not None and not cls.__doc__.startswith(made)
    require(own, f"{cls.__name__} has no docstring")
    for option in options_of(cls):
        fault = f"docstring lacks {option.name} under Attributes:"
        require(option.doc, f"{cls.__name__}'s {fault}")
    # its text builds an equal item
    text = registry.text(item, defaults=True)
    require(registry.parse(text, cls) == item, f"{text} is read back as something else")
