"""What a night of drawn graphs does with one of them.

It is not in ``__main__``, which workers that are spawned cannot import.
"""

from tests.fuzz.exact import int8
from tests.fuzz.exact.drawing import drawing
from tests.fuzz.exact.judging import judged, report
from tests.fuzz.exact.pipelines import LONG, SLOW, some_for

INT8_EVERY, SLOW_EVERY = 10, 200
"""One graph of so many is quantized too, or given to passes that start a process."""


def findings(seed: int) -> list[str]:
    """Judge one graph; tell what no pass may do to it."""
    model = drawing(seed).model
    found = list(judged(seed, model, some_for(model, seed, LONG)))
    if seed % SLOW_EVERY == 0:
        found += judged(seed, model, SLOW)
    if seed % INT8_EVERY == 0:
        found += int8.judged(seed, model)
    return [report(seed, each) for each in found if each.is_bad]
