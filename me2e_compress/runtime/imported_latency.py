"""Read latencies and power that other tools wrote; the content tells the format.

* ``trtexec --exportTimes``: a list of inferences with ``latencyMs`` (copying in,
  computing, copying out; TensorRT's ``samples/common/sampleReporting.cpp``);
* ``trtexec --exportProfile``: ``count``, then layers with ``averageMs``: there are no
  single inferences, so the sum of the averages is one sample;
* a latency trace of our own, made elsewhere;
* the log of ``tegrastats``: milliwatts of the rails of a Jetson, without latencies.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Annotated, TypeVar

from pydantic import BaseModel, Field, TypeAdapter

from me2e_compress.errors import EvaluationError
from me2e_compress.registry import documents
from me2e_compress.runtime.latency_trace import LatencyTrace

FORMATS = (
    "times or a profile of trtexec, a latency trace, or the log of tegrastats is"
    " expected"
)
_RAIL = re.compile(r"\b([A-Z][A-Z0-9_]*) (\d+)mW/\d+mW")
"""Present and average milliwatts; newer releases print both with their unit."""
_LONGEST_MS = 1e9


@dataclass
class Imported:
    """What was read from files of other tools.

    ``samples_us`` has one latency for each inference, ``layers_us`` the average of each
    layer, ``rails_w`` the watts of each rail for each line of the log; all may be
    empty.
    """

    samples_us: tuple[int, ...] = ()
    layers_us: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    rails_w: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    machine: str = ""
    sources: tuple[str, ...] = ()

    @property
    def power(self) -> tuple[str, ...]:
        """The mean and peak of each rail; the input rail includes all others."""
        return tuple(
            f"{name}: {fmean(watts):.2f} W on average, {max(watts):.2f} W at most, over"
            f" {len(watts)} samples (tegrastats)"
            for name, watts in self.rails_w.items()
        )


def read_imports(paths: Sequence[Path]) -> Imported:
    """Read files of other tools, at most one of each kind.

    Raises:
        EvaluationError: a file is not valid, two hold the same, or none has a latency.
    """
    whole = Imported()
    for path in paths:
        part = read_import(path)
        for name in ("samples_us", "layers_us", "rails_w", "machine"):
            if not getattr(part, name):
                continue
            if name != "machine" and getattr(whole, name):
                raise EvaluationError(f"{path}: a second file of the same kind")
            setattr(whole, name, getattr(whole, name) or getattr(part, name))
        whole.sources += part.sources
    # A profile alone gives one latency, the sum of its layers.
    if not whole.samples_us and whole.layers_us:
        whole.samples_us = (sum(taken for (taken,) in whole.layers_us.values()),)
    if not whole.samples_us:
        names = ", ".join(map(str, paths))
        raise EvaluationError(
            f"{names}: no latency in it: give the times of trtexec, too"
        )
    return whole


def read_import(path: Path) -> Imported:
    """Read one file."""
    # The first character tells JSON from a log.
    with documents.reading(path, EvaluationError, FORMATS):
        content = documents.content(path)
        text = content.decode("utf-8-sig", errors="replace")
        if text.lstrip()[:1] not in ("[", "{"):
            rails = dict[str, tuple[float, ...]]()
            for name, milliwatts in _RAIL.findall(text):
                rails[name] = (*rails.get(name, ()), int(milliwatts) / 1e3)
            if not rails:
                raise EvaluationError(f"{path}: {FORMATS}; no power of a rail in it")
            return Imported(rails_w=rails, sources=("tegrastats",))
        found = documents.from_json(content)
        if isinstance(found, dict):
            trace = LatencyTrace.load(path)
            return Imported(
                trace.samples_us, machine=trace.machine, sources=("a trace",)
            )
        # A list is trtexec's; a profile begins with a count.
        first = next((each for each in found if isinstance(each, dict)), {})
        if "count" not in first:
            times = TypeAdapter(_Some[_Time]).validate_python(found)
            samples = tuple(round(1e3 * each.latencyMs) for each in times)
            return Imported(samples, sources=("times of trtexec",))
        # Sum layers of the same name: trtexec repeats the names in loops.
        layers = dict[str, int]()
        for each in TypeAdapter(_Some[_Layer]).validate_python(found[1:]):
            taken = layers.get(each.name, 0) + round(1e3 * each.averageMs)
            layers[each.name] = taken
        by_cost = sorted(layers.items(), key=lambda item: -item[1])
        return Imported(
            layers_us={name: (taken,) for name, taken in by_cost},
            sources=("a profile of trtexec",),
        )


_Ms = Annotated[float, Field(ge=0.0, le=_LONGEST_MS, allow_inf_nan=False)]


class _Time(BaseModel):
    latencyMs: _Ms  # noqa: N815 - trtexec's name


class _Layer(BaseModel):
    name: str
    averageMs: _Ms  # noqa: N815 - trtexec's name


_T = TypeVar("_T")
_Some = Annotated[list[_T], Field(min_length=1)]
