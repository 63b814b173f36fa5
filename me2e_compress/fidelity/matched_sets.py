"""Agents as sets: each of one model's is compared with the other's nearest.

A detector that keeps its strongest peaks sorts them by strength; rounding swaps two of
nearly the same strength, so a comparison slot by slot compares different cars. Only
sure agents count here: the rest of the slots come and go.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import pydantic

from me2e_compress.errors import GraphError
from me2e_compress.registry import documents
from me2e_compress.runtime.frames import Array

SETS = "me2e.sets"
"""Metadata key: JSON of :class:`SetOutputs`."""

SURE = 0.5
"""Score from which an agent is sure: more likely there than not."""

SAME_M = 2.0
"""Centres farther apart are two agents: the largest distance at which nuScenes'
detection benchmark calls one found."""


class SetOutputs(pydantic.BaseModel):
    """Outputs [1, agents, ...] whose rows belong together, in no order.

    Rows of ``boxes`` begin with x and y, metres; ``scores`` are probabilities [1,
    agents]. Learned queries, as in DETR, keep their slots: compare those slot by slot.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    boxes: str = "boxes"
    scores: str = "scores"
    others: tuple[str, ...] = ("futures",)

    @classmethod
    def of(
        cls, metadata: Mapping[str, str], shapes: Mapping[str, Sequence[object]]
    ) -> Self | None:
        """Read it from a model's metadata; else look for outputs of the default names.

        Returns None if the model has no such metadata, or lacks one of the outputs.
        """
        text = metadata.get(SETS)
        try:
            named = {} if text is None else documents.from_json(text)
            found = cls.model_validate(named)
        except (documents.MalformedError, pydantic.ValidationError) as error:
            first = str(error).splitlines()[0]
            raise GraphError(f"metadata {SETS} names no outputs: {first}") from error
        # boxes and scores must have a row per agent
        rows = {tuple(shapes.get(each, ())[:2]) for each in (found.boxes, found.scores)}
        if len(rows) != 1 or len(shapes.get(found.boxes, ())) != 3:
            return None
        if len(shapes[found.scores]) != 2:
            return None
        # other outputs count if they have them too
        others = tuple(
            each for each in found.others if tuple(shapes.get(each, ())[:2]) in rows
        )
        return found.model_copy(update={"others": others})


@dataclass(frozen=True)
class SetFidelity:
    """Sure agents of the first model against those of the second, all frames pooled.

    Attributes:
        agents: that the first model is sure of.
        found: with one of the second within 2 m.
        kept: found ones that the second is sure of.
        added: that only the second is sure of; the first has none within 2 m.
        centre_m: mean distance of those found; None without.
        sqnr_db: over those found, by output.
    """

    agents: int
    found: int
    kept: int
    added: int
    centre_m: float | None
    sqnr_db: Mapping[str, float]


@dataclass
class SetTally:
    """Sums over frames of one set of outputs."""

    outputs: SetOutputs
    agents: int = 0
    kept: int = 0
    added: int = 0
    away_m: list[float] = field(default_factory=list)
    power: dict[str, list[float]] = field(default_factory=dict)

    def add(self, left: Mapping[str, Array], right: Mapping[str, Array]) -> None:
        """Match one frame: the assignment with the smallest sum of distances."""
        from scipy.optimize import linear_sum_assignment  # takes long to import

        # sure agents of the first model to the nearest of the second, each used once
        named = self.outputs
        places, others = (each[named.boxes][0, :, :2] for each in (left, right))
        sure, secure = (each[named.scores][0] >= SURE for each in (left, right))
        self.agents += int(sure.sum())
        away = np.linalg.norm(
            places[:, None].astype(np.float64) - others.astype(np.float64), axis=2
        )
        rows = np.flatnonzero(sure)
        picked, columns = linear_sum_assignment(np.minimum(away[rows], SAME_M))
        near = away[rows[picked], columns] < SAME_M
        mine, theirs = rows[picked][near], columns[near]
        # found, kept and added agents
        self.away_m += away[mine, theirs].tolist()
        self.kept += int(secure[theirs].sum())
        new = np.setdiff1d(np.flatnonzero(secure), theirs)
        self.added += int((away[:, new].min(axis=0, initial=np.inf) >= SAME_M).sum())
        # signal and noise of matched rows
        for name in (named.boxes, named.scores, *named.others):
            one = np.asarray(left[name][0][mine], np.float64)
            gap = one - np.asarray(right[name][0][theirs], np.float64)
            sums = self.power.setdefault(name, [0.0, 0.0])
            sums[0] += float(np.vdot(one, one))
            sums[1] += float(np.vdot(gap, gap))

    def result(self) -> SetFidelity:
        """Return the figures of all frames."""
        found = len(self.away_m)
        return SetFidelity(
            *(self.agents, found, self.kept, self.added),
            float(np.mean(self.away_m)) if found else None,
            {name: _decibels(*sums) for name, sums in self.power.items() if found},
        )


def _decibels(signal: float, noise: float) -> float:
    if noise == 0.0:
        return math.inf
    return 10.0 * math.log10(signal / noise) if signal else -math.inf
