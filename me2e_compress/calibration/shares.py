"""Identify the shards of a sample, and check that they are complete."""

import dataclasses
from collections.abc import Sequence

from me2e_compress.errors import FramesError


@dataclasses.dataclass(frozen=True)
class Share:
    """One of ``count`` shards, from 1, of the frames ``drawn`` from a recording."""

    number: int
    count: int
    drawn: tuple[int, ...]


def check_whole(shares: Sequence[Share | None]) -> None:
    """Check that shards are all those of one sample.

    None stands for statistics that are not a shard; all None is accepted.
    """
    known = [each for each in shares if each is not None]
    if not known:
        return
    if len(known) < len(shares):
        raise FramesError("some of the files are shards, others a whole calibration")
    first = known[0]
    # All must belong to one sample.
    for each in known[1:]:
        if each.count != first.count:
            raise FramesError(
                f"shards do not belong together: shard {each.number} of {each.count},"
                f" shard {first.number} of {first.count}"
            )
        if each.drawn != first.drawn:
            raise FramesError(
                f"shards do not belong together: shards {first.number} and"
                f" {each.number} are of different draws ({len(first.drawn)} and"
                f" {len(each.drawn)} frames): give -n and --seed alike"
            )
    # All shards must be there.
    numbers = [each.number for each in known]
    if missing := [at for at in range(1, first.count + 1) if at not in numbers]:
        raise FramesError(
            f"shard {missing[0]} of {first.count} is missing, and"
            f" {len(missing) - 1} more: ranges are of all frames that were drawn"
        )
