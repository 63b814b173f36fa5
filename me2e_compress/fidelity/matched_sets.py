"""Outputs that are sets of agents: each agent is compared with the other's nearest.

A detector that sorts its agents by strength swaps two of nearly the same strength after
rounding, so a comparison slot by slot compares different cars.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import pydantic

from me2e_compress.errors import GraphError
from me2e_compress.fidelity.compare import decibels
from me2e_compress.registry import documents
from me2e_compress.runtime.frames import Array, Frame

SETS = "me2e.sets"
"""Metadata key: JSON of :class:`SetOutputs`."""

SURE = 0.5
"""Score from which an agent counts: more likely there than not."""

SAME_M = 2.0
"""Centres farther apart are two agents: the largest distance at which nuScenes'
detection benchmark matches them."""


class SetOutputs(pydantic.BaseModel):
    """Outputs [1, agents, ...] whose rows belong together, in no order.

    Rows of ``boxes`` begin with x and y, metres; ``scores`` are probabilities [1,
    agents].
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    boxes: str
    scores: str
    others: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all outputs of the set."""
        return (self.boxes, self.scores, *self.others)

    @classmethod
    def of(
        cls, metadata: Mapping[str, str], shapes: Mapping[str, Sequence[object]]
    ) -> Self | None:
        """Read it from a model's metadata; None without.

        Raises:
            GraphError: it is malformed, or an output lacks a row for every agent.
        """
        text = metadata.get(SETS)
        if text is None:
            return None
        try:
            outputs = cls.model_validate(documents.from_json(text))
        except (documents.MalformedError, pydantic.ValidationError) as error:
            first = str(error).splitlines()[0]
            raise GraphError(f"metadata {SETS} names no outputs: {first}") from error
        rows = tuple(shapes.get(outputs.boxes, ()))[:2]
        for name in outputs.names:
            shape = tuple(shapes.get(name, ()))
            if len(shape) < 2 or shape[:2] != rows:
                raise GraphError(f"metadata {SETS}: {name} has no row for every agent")
        return outputs


@dataclass(frozen=True)
class SetFidelity:
    """Sure agents of the first model against those of the second, all frames pooled.

    Attributes:
        agents: that the first model is sure of.
        matched: with one of the second within 2 m.
        sqnr_db: over those matched, by output.
    """

    agents: int
    matched: int
    sqnr_db: Mapping[str, float]


@dataclass
class SetTally:
    """Sums over frames of one set of outputs."""

    outputs: SetOutputs
    agents: int = 0
    matched: int = 0
    power: dict[str, list[float]] = field(default_factory=dict)

    def add(
        self, left: Mapping[str, Array], right: Mapping[str, Array], frame: Frame
    ) -> None:
        """Match one frame: the assignment with the smallest sum of distances."""
        from scipy.optimize import linear_sum_assignment  # takes long to import

        outputs = self.outputs
        places, others = (each[outputs.boxes][0, :, :2] for each in (left, right))
        rows = np.flatnonzero(left[outputs.scores][0] >= SURE)
        gaps = places[rows, None].astype(np.float64) - others.astype(np.float64)
        distances = np.linalg.norm(gaps, axis=2)
        picked, columns = linear_sum_assignment(np.minimum(distances, SAME_M))
        near = distances[picked, columns] < SAME_M
        mine, theirs = rows[picked][near], columns[near]
        self.agents += len(rows)
        self.matched += len(mine)
        # signal and noise of matched rows
        for name in outputs.names:
            one = np.asarray(left[name][0][mine], np.float64)
            gap = one - np.asarray(right[name][0][theirs], np.float64)
            sums = self.power.setdefault(name, [0.0, 0.0])
            sums[0] += float(np.vdot(one, one))
            sums[1] += float(np.vdot(gap, gap))

    def result(self) -> SetFidelity:
        """Return the figures of all frames."""
        return SetFidelity(
            self.agents,
            self.matched,
            {name: decibels(*p) for name, p in self.power.items() if self.matched},
        )
