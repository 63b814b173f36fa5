"""Models timed side by side, so that a noisy machine is noisy to all of them."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from time import perf_counter, process_time

from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session, replay


@dataclasses.dataclass(frozen=True)
class Lap:
    """What one model took, round by round.

    Attributes:
        wall_s: seconds on the clock.
        cpu_s: seconds of CPU, all threads together.
    """

    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]

    @property
    def median_wall_s(self) -> float:
        """Median wall time, seconds."""
        return median(self.wall_s)

    @property
    def best_wall_s(self) -> float:
        """Least wall time, seconds: what an idle machine would take."""
        return min(self.wall_s)


def race(
    sessions: Mapping[str, Session],
    frames: Sequence[Frame],
    rounds: int,
    on_run: Callable[[int, int, str], None] | None = None,
) -> dict[str, Lap]:
    """Time one frame of every model in turn, A B C A B C, after a round unmeasured.

    Args:
        sessions: the models by name, all with the same number of threads.
        frames: the first one is run, with recurrent state at zeros.
        rounds: how often each is measured.
        on_run: told runs done, runs in all and the model's name.
    """
    wall: dict[str, list[float]] = {name: [] for name in sessions}
    cpu: dict[str, list[float]] = {name: [] for name in sessions}
    total = (rounds + 1) * len(sessions)
    for turn in range(rounds + 1):
        for place, (name, session) in enumerate(sessions.items()):
            if on_run is not None:
                on_run(turn * len(sessions) + place, total, name)
            start, used = perf_counter(), process_time()
            for _ in replay(session, frames[:1]):
                pass
            if turn:
                wall[name].append(perf_counter() - start)
                cpu[name].append(process_time() - used)
    return {name: Lap(tuple(wall[name]), tuple(cpu[name])) for name in sessions}
