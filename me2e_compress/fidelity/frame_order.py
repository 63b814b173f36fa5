"""Frames whose answers stand in another order in a dump."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from me2e_compress.fidelity.dump_readings import Order, closeness
from me2e_compress.runtime.frames import Array

SAMPLED = 512
"""Values of an output that frames are told apart by."""


@dataclass(frozen=True)
class FrameOrder:
    """Answers that stand at other frames: for each frame, where the dump has them."""

    places: Order

    @property
    def said(self) -> str:
        """Name the order in words, or the first frames that moved."""
        count = len(self.places)
        as_text = sorted(range(count), key=str)
        if self.places == tuple(reversed(range(count))):
            told = "reversed"
        elif [self.places[at] for at in as_text] == list(range(count)):
            told = "sorted as text: 0, 1, 10, 11, ..., 2"
        else:
            moved = [at for at, to in enumerate(self.places) if at != to]
            told = ", ".join(f"{at} at {self.places[at]}" for at in moved[:3])
        return f"frames are in another order: {told}"


def sample(answers: Mapping[str, Array]) -> dict[str, Array]:
    """Return a few values of each output, the same ones on every frame."""
    return {
        name: np.array(
            each.reshape(-1)[:: max(1, each.size // SAMPLED)], dtype=np.float64
        )
        for name, each in answers.items()
    }


def find_order(
    truths: Sequence[Mapping[str, Array]], found: Sequence[Mapping[str, Array]]
) -> FrameOrder | None:
    """Return the order of frames that brings samples together; None if as recorded."""
    from scipy.optimize import linear_sum_assignment  # takes long to import

    near = np.array(
        [
            [np.mean([closeness(a[name], b[name]) for name in a]) for b in found]
            for a in truths
        ]
    )
    places = tuple(int(each) for each in linear_sum_assignment(-near)[1])
    return None if places == tuple(range(len(places))) else FrameOrder(places)
