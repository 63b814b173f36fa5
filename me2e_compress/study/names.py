"""Names within a study: unique, and usable as file names."""

import re
from collections import Counter
from collections.abc import Iterable

from me2e_compress.errors import StudyError

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]*")


def check_name(kind: str, name: str) -> None:
    """Check that a name can name a folder: it begins with a letter or digit."""
    if _NAME.fullmatch(name) is None:
        raise StudyError(
            f"{kind} {name!r}: a name is made of letters, digits, '_', '+' and '-'"
        )


def check_unique(kind: str, names: Iterable[str]) -> None:
    """Check that there are names, without repetition."""
    counts = Counter(names)
    if not counts:
        raise StudyError(f"the study has no {kind}")
    name, count = counts.most_common(1)[0]
    if count > 1:
        raise StudyError(f"{count} {kind}s are named {name}")
