"""Read latencies that other tools wrote; the content tells the format.

* ``trtexec --exportTimes``: a list of inferences with ``latencyMs`` (copying in,
  computing, copying out; TensorRT's ``samples/common/sampleReporting.cpp``);
* ``trtexec --exportProfile``: ``count``, then layers with ``averageMs``: there are no
  single inferences, so the sum of the averages is one sample;
* a latency trace of our own, made elsewhere.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, Field, TypeAdapter

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError
from me2e_compress.runtime.latency_trace import LatencyTrace

FORMATS = "times or a profile of trtexec, or a latency trace, is expected"
_LONGEST_MS = 1e9


@dataclass(frozen=True)
class ImportedLatency:
    """What was read from a file of another tool.

    ``samples_us`` has one latency for each inference, ``layers_us`` the average of each
    layer, which may be empty; ``machine`` is what measured.
    """

    samples_us: tuple[int, ...]
    machine: str
    layers_us: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


def read_latencies(path: Path) -> ImportedLatency:
    """Read one file; an EvaluationError if it is missing, or of no such form."""
    with documents.reading(path, EvaluationError, FORMATS):
        document = documents.from_json(documents.read_bytes(path))
        if isinstance(document, dict):
            trace = LatencyTrace.load(path)
            return ImportedLatency(trace.samples_us, trace.machine or "a trace")
        # A list is trtexec's; a profile begins with a count.
        first = next((each for each in document if isinstance(each, dict)), {})
        if "count" not in first:
            times = TypeAdapter(_NonEmpty[_Time]).validate_python(document)
            samples = tuple(round(1e3 * each.latencyMs) for each in times)
            return ImportedLatency(samples, "times of trtexec")
        # Sum layers of the same name: trtexec repeats the names in loops.
        layers = dict[str, int]()
        for each in TypeAdapter(_NonEmpty[_Layer]).validate_python(document[1:]):
            total_us = layers.get(each.name, 0) + round(1e3 * each.averageMs)
            layers[each.name] = total_us
        by_cost = sorted(layers.items(), key=lambda item: -item[1])
        layers_us = {name: (total_us,) for name, total_us in by_cost}
        total = (sum(layers.values()),)
        return ImportedLatency(total, "a profile of trtexec", layers_us)


_Ms = Annotated[float, Field(ge=0.0, le=_LONGEST_MS, allow_inf_nan=False)]


class _Time(BaseModel):
    latencyMs: _Ms  # noqa: N815 - trtexec's name


class _Layer(BaseModel):
    name: str
    averageMs: _Ms  # noqa: N815 - trtexec's name


_T = TypeVar("_T")
_NonEmpty = Annotated[list[_T], Field(min_length=1)]
