from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from me2e_compress.base.errors import StudyError, VerificationError
from me2e_compress.base.registry import Registry
from me2e_compress.quantization.rules import RULE_SETS, RULES
from me2e_compress.targets import TARGETS
from me2e_compress.testing import check_form

THINGS: Registry[Any] = Registry("thing", "", StudyError, {})


@dataclass(frozen=True)
class Good:
    """A thing.

    Attributes:
        size: In metres.
    """

    name: ClassVar[str] = "good-thing"
    size: float = 1.0


def test_a_thing_holds() -> None:
    check_form(Good(2.5), THINGS)


@pytest.mark.parametrize("registry", [RULES, RULE_SETS, TARGETS])
def test_ours_hold(registry: Registry[Any]) -> None:
    for name in registry.names():
        check_form(registry.build(name, {}), registry)


class Undecorated(Good):
    """A thing without options of its own."""


@dataclass(frozen=True)
class Shouting(Good):
    """A thing.

    Attributes:
        size: In metres.
    """

    name: ClassVar[str] = "BadThing"


@dataclass(frozen=True)
class Silent(Good):
    pass


@dataclass(frozen=True)
class Terse(Good):
    """A thing of some size and weight."""

    weight: float = 1.0


@dataclass(frozen=True)
class Forgetful(Good):
    """A thing.

    Attributes:
        size: In metres.
        parts: Plain ones.
    """

    parts: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Rounding(Good):
    """A thing.

    Attributes:
        size: In metres, rounded.
    """

    def __eq__(self, other: object) -> bool:
        return False


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (Undecorated(), "Undecorated is not a frozen dataclass"),
        (Shouting(), "'BadThing' is not a name-like-this"),
        (Silent(), "Silent has no docstring"),
        (Terse(), "Terse's docstring lacks weight under Attributes:"),
        (Rounding(), "good-thing:1 is read back as something else"),
    ],
)
def test_what_is_no_plain_data_is_caught(bad: Good, message: str) -> None:
    with pytest.raises(VerificationError, match=message):
        check_form(bad, THINGS)


def test_an_option_that_text_cannot_hold_is_named() -> None:
    with pytest.raises(StudyError, match="good-thing: parts"):
        check_form(Forgetful(parts=frozenset({1})), THINGS)
