"""Learn how often a counter moves, by watching it."""

from collections.abc import Callable
from itertools import pairwise
from statistics import median

FIRST_STEPS = 5
"""Steps in a row from which the first guess is made: good to a poll in a step."""
POLL_S = 0.002
LONGEST_STEP_S = 2.0
"""A counter that does not move for this long does not work."""


def learnt_step(
    joules: Callable[[], float],
    clock: Callable[[], float],
    sleep: Callable[[float], None],
    for_s: float,
) -> float | None:
    """Return the seconds between two updates of a counter; None if it stands still.

    A guess from a few steps is 1 % off, and over a window of 100 steps that is a whole
    one: frames held up by it (`estimate.detuning`) may keep step with the counter after
    all. So the counter is watched for ``for_s`` seconds: each time twice as far as so
    far, which the last guess numbers without doubt. What is left is a poll in all.
    """
    begun = clock()
    moves = list[float]()
    while len(moves) <= FIRST_STEPS:
        at = _next_move(joules, clock, sleep)
        if at is None:
            return None
        moves.append(at)
    step, first, last = median(b - a for a, b in pairwise(moves)), moves[0], moves[-1]
    while (left := begun + for_s - clock()) > 0.0:
        sleep(min(last - first, left))
        at = _next_move(joules, clock, sleep)
        if at is None:
            return None
        last = at
        step = (last - first) / round((last - first) / step)
    return step


def _next_move(
    joules: Callable[[], float],
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> float | None:
    """Return when the counter moves next; None if it does not."""
    since, before = clock(), joules()
    while clock() - since <= LONGEST_STEP_S:
        sleep(POLL_S)
        if joules() != before:
            return clock()
    return None
