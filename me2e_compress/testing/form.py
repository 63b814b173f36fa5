"""Check what all items of registries have in common."""

import re
from typing import TypeVar

from me2e_compress.errors import VerificationError
from me2e_compress.registry import NamedItem, Registry, options_of

_KEBAB = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")

T = TypeVar("T", bound=NamedItem)


def check_class(item: NamedItem) -> None:
    """Check that an item is of a frozen dataclass with a name-like-this."""
    cls = type(item)
    # of its own: an undecorated class inherits that of its base
    parameters = vars(cls).get("__dataclass_params__")
    if parameters is None or not parameters.frozen:
        raise VerificationError(f"{cls.__name__} is not a frozen dataclass")
    if _KEBAB.fullmatch(item.name) is None:
        raise VerificationError(f"{item.name!r} is not a name-like-this")


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
    if cls.__doc__ is None or cls.__doc__.startswith(f"{cls.__name__}("):
        raise VerificationError(f"{cls.__name__} has no docstring")
    for option in options_of(cls):
        if not option.doc:
            raise VerificationError(
                f"{cls.__name__}'s docstring lacks {option.name} under Attributes:"
            )
    # its text builds an equal item
    text = registry.text(item, defaults=True)
    if registry.parse(text, cls) != item:
        raise VerificationError(f"{text} is read back as something else")
