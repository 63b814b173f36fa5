"""What a study is put together from: blocks of drives, frames of its own."""

from collections.abc import Sequence
from dataclasses import dataclass

from me2e_compress.errors import StudyError
from me2e_compress.study.names import check_name


@dataclass(frozen=True)
class StudyBlock:
    """A part of a study: some of its variants under some of its conditions.

    Args:
        name: As a variant's.
        variants: Names, in the order of its tables.
        conditions: Names, in the order of its tables.

    Raises:
        StudyError: A bad name, or nothing to drive.
    """

    name: str
    variants: tuple[str, ...]
    conditions: tuple[str, ...]

    def __post_init__(self) -> None:
        """Refuse what drives nothing."""
        check_name("block", self.name)
        if not self.variants or not self.conditions:
            raise StudyError(f"block {self.name}: there is nothing to drive")

    def check(self, variants: Sequence[str], conditions: Sequence[str]) -> None:
        """Hold its names against those that there are.

        Raises:
            StudyError: It names another.
        """
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
    """Frames that a study records itself: its baseline's on fresh routes.

    Args:
        frames: So many to calibrate on.
        held_out: So many to measure fidelity and latency on, of the next seed.
        seed: Of the routes.

    Raises:
        StudyError: None at all, or a negative seed.
    """

    frames: int
    held_out: int
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        if min(self.frames, self.held_out) < 1:
            raise StudyError(
                f"record: {self.frames} frames and {self.held_out} held out: both must"
                " be 1 or more"
            )
        if self.seed < 0:
            raise StudyError(f"record: seed {self.seed}: must be 0 or more")
