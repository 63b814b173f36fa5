"""Bench2Drive's five abilities."""

from collections.abc import Sequence

from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import InfractionKind

ABILITIES = (
    "Overtaking",
    "Merging",
    "Emergency_Brake",
    "Give_Way",
    "Traffic_Signs",
)
TRAFFIC_SIGNS = "Traffic_Signs"

JUNCTION_MARGIN_M = 8.0
"""How far past the start of a junction the ego must come to have obeyed its signs."""


def mastered(episode: Episode, ability: str) -> bool:
    """Return whether a route counts as a success for one of its abilities.

    For Traffic_Signs a failed route also counts if the ego passed its first junction by
    more than 8 m without running a stop sign or a red light (ability_benchmark.py of
    Bench2Drive 0.0.4; version 0.0.3 adds the two counts and halves the sum).
    """
    if episode.succeeded:
        return True
    return ability == TRAFFIC_SIGNS and _obeyed_the_signs(episode)


def successes(episodes: Sequence[Episode]) -> dict[str, tuple[bool, ...]]:
    """Return, for each ability, whether each route that tests it was mastered."""
    return {
        ability: tuple(
            mastered(episode, ability)
            for episode in episodes
            if ability in episode.abilities
        )
        for ability in ABILITIES
    }


def _obeyed_the_signs(episode: Episode) -> bool:
    if episode.junction_m is None:
        return False
    passed_m = episode.completion_percent / 100.0 * episode.route_length_m
    broken = (InfractionKind.STOP, InfractionKind.RED_LIGHT)
    return passed_m > episode.junction_m + JUNCTION_MARGIN_M and not any(
        infraction.kind in broken for infraction in episode.infractions
    )
