"""The same routes of several folders of results, for scores that compare them."""

from collections.abc import Mapping, Sequence

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.episode import Episode

UNPAIRED = "a drive in each"
"""Beside the measures that may be missing: why a route is left out."""


def paired_drives(
    folders: Mapping[str, Sequence[Episode]],
) -> tuple[dict[str, list[Episode]], int]:
    """Return what all folders drove, in the order of the first, and how much not all.

    A real run may lack routes on which CARLA crashed; other results lack none.

    Args:
        folders: Episodes by the name of the folder.

    Returns:
        The episodes of the routes that all folders hold, and the number of the others.

    Raises:
        EvaluationError: Folders hold different routes, and are not all of real runs
            with a route in common.
    """
    by_route = {
        name: {each.route: each for each in episodes}
        for name, episodes in folders.items()
    }
    first = next(iter(by_route.values()), {})
    shared = [each for each in first if all(each in own for own in by_route.values())]
    real = all(each.given for episodes in folders.values() for each in episodes)
    for name, own in by_route.items():
        unpaired = sorted({*own} ^ {*first})
        if unpaired and not (real and shared):
            raise EvaluationError(
                f"{name}: route {unpaired[0]} is in one of the folders only: EER_AV "
                "compares the same routes"
            )
    every = {route for own in by_route.values() for route in own}
    paired = {name: [own[each] for each in shared] for name, own in by_route.items()}
    return paired, len(every) - len(shared)
