"""Decisions logged by `RealTimeAgent`, one per line."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from me2e_compress import documents
from me2e_compress.evaluators.bench2drive.recordings import (
    TICK_S,
    BrokenRecordingError,
)
from me2e_compress.metrics.episode import LARGEST, InferenceRecord

_Count = Annotated[int, Field(ge=0, le=LARGEST)]


class _Line(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")
    frame: _Count
    latency_us: _Count


def read_decisions(path: Path) -> tuple[InferenceRecord, ...]:
    """Read a ``decisions.jsonl``."""
    found = list[InferenceRecord]()
    lines = documents.content(path, documents.LARGEST_LOG_BYTES).splitlines()
    for number, line in enumerate(lines, 1):
        try:
            noted = _Line.model_validate(documents.from_json(line))
        except (documents.MalformedError, ValidationError) as error:
            raise BrokenRecordingError(f"line {number} is no decision") from error
        time_us = round(1e6 * TICK_S * noted.frame)
        found.append(InferenceRecord(time_us, noted.latency_us))
    return tuple(found)
