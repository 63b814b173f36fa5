"""Find the routes that several folders of results share, to compare their scores."""

from collections.abc import Mapping, Sequence

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.episode import Episode

UNPAIRED = "a drive in each"
"""Why a route is left out, listed beside the measures that may be missing."""


def paired_drives(
    folders: Mapping[str, Sequence[Episode]],
) -> tuple[dict[str, list[Episode]], int]:
    """Return the episodes on shared routes by folder, and the number of other routes.

    The routes are in the first folder's order. Only real runs may lack routes, on which
    CARLA crashed; other folders must hold the same, or EvaluationError is raised.
    """
    by_route = {
        name: {each.route: each for each in episodes}
        for name, episodes in folders.items()
    }
    first = next(iter(by_route.values()), {})
    shared = [each for each in first if all(each in own for own in by_route.values())]
    # differing routes are an error unless every folder is a real run
    real = all(each.given for episodes in folders.values() for each in episodes)
    for name, own in by_route.items():
        unpaired = sorted({*own} ^ {*first})
        if unpaired and not (real and shared):
            raise EvaluationError(
                f"{name}: route {unpaired[0]} is in one of the folders only: EER_AV "
                "compares the same routes"
            )
    # count the routes that not all folders hold
    every = {route for own in by_route.values() for route in own}
    paired = {name: [own[each] for each in shared] for name, own in by_route.items()}
    return paired, len(every) - len(shared)
