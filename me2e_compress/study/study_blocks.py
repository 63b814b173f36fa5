"""Parts of a study: names, blocks of drives, and frames of its own."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class StudyBlock:
    """Some variants under some conditions, named in the order of the block's tables.

    Raises:
        StudyError: A name is invalid, or there is nothing to drive.
    """

    name: str
    variants: tuple[str, ...]
    conditions: tuple[str, ...]

    def __post_init__(self) -> None:
        check_name("block", self.name)
        if not self.variants or not self.conditions:
            raise StudyError(f"block {self.name}: there is nothing to drive")

    def check(self, variants: Sequence[str], conditions: Sequence[str]) -> None:
        """Check that its variants and conditions exist."""
        for kind, named, there in (
            ("variant", self.variants, variants),
            ("condition", self.conditions, conditions),
        ):
            unknown = [name for name in named if name not in there]
            if unknown:
                raise StudyError(
                    f"block {self.name}: no {kind} {unknown[0]}; there are "
                    f"{', '.join(there)}"
                )


@dataclass(frozen=True)
class FramesToRecord:
    """Frames of the baseline that a study records itself, on fresh routes.

    Args:
        frames: Number of frames to calibrate on.
        held_out: Number of frames to measure fidelity and latency on, of the next seed.
        seed: Seed of the routes.

    Raises:
        StudyError: There are none at all, or the seed is negative.
    """

    frames: int
    held_out: int
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.frames, self.held_out) < 1:
            raise StudyError(
                f"record: {self.frames} frames and {self.held_out} held out: both must"
                " be 1 or more"
            )
        if self.seed < 0:
            raise StudyError(f"record: seed {self.seed}: must be 0 or more")
