"""Weights and scales of EER_AV in a file, for later calls to score alike."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, TypeAdapter, with_config

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.eer import MEASURES, EerResult, EerScale, Normalization
from me2e_compress.registry import documents, drafts
from me2e_compress.runtime.atomic import write_json

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")
_Four = Annotated[dict[str, float], Field(min_length=4, max_length=4)]


@with_config(_STRICT)
@dataclasses.dataclass(frozen=True)
class SavedWeights:
    """A scale by the names of the measures; its joules are measured."""

    energy: Literal["measured"]
    normalization: Normalization
    weights: _Four
    offset: _Four
    span: _Four

    @classmethod
    def of(cls, scale: EerScale) -> "SavedWeights":
        """Build the saved form of a scale."""
        columns = (scale.weights, scale.offset, scale.span)
        named = [dict(zip(MEASURES, each, strict=True)) for each in columns]
        return cls("measured", scale.normalization, *named)

    @classmethod
    def load(cls, path: Path) -> "SavedWeights":
        """Read a file that `save` wrote."""
        with documents.reading(path, EvaluationError, "no file of weights"):
            found = _FILE.validate_python(documents.from_json(documents.content(path)))
        # the form alone does not say which names there must be, or their signs
        for column in (found.weights, found.offset, found.span):
            if set(column) != set(MEASURES):
                names = ", ".join(MEASURES)
                raise EvaluationError(f"{path}: it must name {names}")
        if min(found.span.values()) <= 0.0 or min(found.weights.values()) < 0.0:
            raise EvaluationError(f"{path}: a span or a weight is not positive")
        return found

    def scale(self) -> EerScale:
        """Return the scale as `metrics.eer` takes it."""
        weights, offset, span = (
            (each[MEASURES[0]], each[MEASURES[1]], each[MEASURES[2]], each[MEASURES[3]])
            for each in (self.weights, self.offset, self.span)
        )
        return EerScale(self.normalization, weights, offset, span)


def save_weights(path: Path, result: EerResult) -> None:
    """Write the scale that a result was made by."""
    if result.scale is None:
        reason = next(iter(result.scores.values())).measure.reason
        raise EvaluationError(f"{path}: there are no weights to save: {reason}")
    saved = SavedWeights.of(result.scale)
    with drafts.written(path, EvaluationError):
        write_json(path, dataclasses.asdict(saved), indent=1)


_FILE = TypeAdapter(SavedWeights)
