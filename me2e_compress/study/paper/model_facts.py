"""Facts about a variant's file, apart from how it drives."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config

from me2e_compress import documents, graph
from me2e_compress.errors import StudyError
from me2e_compress.graph import WEIGHTED
from me2e_compress.quantization.plan import plan_of
from me2e_compress.runtime.atomic import write_json
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.runtime.energy.modelled import DEFAULT_PROCESS
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.timing import Clock
from me2e_compress.workflows.inspect import inspect

FILE = "variants.json"
SCHEMES = ("exact", "prediction", "feature-ext", "full")
"""Rows of table 4."""

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")


@with_config(_STRICT)
@dataclass(frozen=True)
class Int8Counts:
    """Counts of the int8 part of a graph.

    ``tensors`` are activations with a scale of their own (nodes that quantize),
    ``operators`` are nodes that read int8: layers, attention products, residual Adds.
    Those that are convolutions or matrix products are ``compute_intensive``.
    """

    tensors: int
    operators: int
    compute_intensive: int


@with_config(_STRICT)
@dataclass(frozen=True)
class ModelFacts:
    """A variant's file.

    Attributes:
        pipeline: The passes that made it, as text.
        size_bytes: Size of the file with its weights.
        macs: Multiply-accumulates of one inference.
        int8: None for a file without a plan.
        latency_us: Latencies of inferences alone, warm, on the target device.
        modules_us: Latencies by module under a profiler, on the target device.
        modelled_j: Joules per frame from published energies of MACs and bytes.
        joules: Measured joules per frame, and the ends of their 95 % interval; None
            without a counter, and ``no_joules`` says why.
        failure: Why there is no file that can drive; empty if there is one.
    """

    variant: str
    sha256: str | None = None
    pipeline: str = ""
    size_bytes: int | None = None
    parameters: int | None = None
    macs: int | None = None
    int8: Int8Counts | None = None
    latency_us: tuple[int, ...] = ()
    modules_us: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    modelled_j: float | None = None
    joules: tuple[float, float, float] | None = None
    no_joules: str = "not measured"
    failure: str = ""

    def latency_ms(self, percent: float) -> float | None:
        """Return a percentile of the latencies; None if none were measured."""
        if not self.latency_us:
            return None
        return float(np.percentile(self.latency_us, percent, method="higher")) / 1e3

    @property
    def fps(self) -> float | None:
        """Inferences per second at the mean latency, as in the paper's FPS column."""
        if not self.latency_us:
            return None
        return 1e6 / float(np.mean(self.latency_us))

    @property
    def of_another_stack(self) -> bool:
        """Whether it serves table 4 only: a variant's name has no space."""
        return " " in self.variant

    def with_energy(self, found: EnergyResult) -> "ModelFacts":
        """Return it with a counter's measurement, or why there is none."""
        if found.j_per_frame is None:
            return replace(self, no_joules=found.reason)
        low, high = found.low or 0.0, found.high or found.j_per_frame
        return replace(self, joules=(found.j_per_frame, low, high), no_joules="")


_FACTS = TypeAdapter(tuple[ModelFacts, ...])


def facts_of(
    prepared: PreparedVariant, clock: Clock, known: Mapping[str, ModelFacts]
) -> ModelFacts:
    """Collect the facts of a variant's file, unless they are already known."""
    # latencies are scaled to the device
    name = prepared.variant.name
    trace = clock.traces.get(name)
    latency_us = () if trace is None else _scaled(trace.samples_us, clock.scale)
    # known facts are reused if the file is the same
    before = known.get(name)
    if prepared.model is None:
        return ModelFacts(name, failure=prepared.failure)
    if before and before.modelled_j and before.sha256 == prepared.sha256:
        return (
            before
            if before.latency_us == latency_us
            else replace(before, latency_us=latency_us, modules_us={})
        )
    # otherwise count the graph anew
    module_map = prepared.variant.module_map
    found = inspect(prepared.model, module_map, None, DEFAULT_PROCESS)
    modelled = found.modelled_energy
    return ModelFacts(
        name,
        prepared.sha256,
        prepared.pipeline,
        prepared.size_bytes,
        sum(each.parameters for each in found.modules),
        found.macs,
        int8_counts(prepared.model),
        latency_us,
        modelled_j=None if modelled is None else modelled.modelled_j_per_frame,
    )


def weighed(folder: Path) -> tuple[ModelFacts, ...]:
    """Count the files of another stack, for table 4 only.

    The folder has the stack's name and some of ``exact.onnx``, ``prediction.onnx``,
    ``feature-ext.onnx`` and ``full.onnx``.
    """
    files = [(scheme, folder / f"{scheme}.onnx") for scheme in SCHEMES]
    there = [(scheme, path) for scheme, path in files if path.is_file()]
    if not there:
        raise StudyError(f"{folder}: none of {', '.join(SCHEMES)} as .onnx")
    return tuple(
        ModelFacts(
            f"{folder.resolve().name} {scheme}",
            graph.sha256_of(path),
            size_bytes=graph.file_bytes(path),
            int8=int8_counts(path),
        )
        for scheme, path in there
    )


def int8_counts(path: Path) -> Int8Counts | None:
    """Count the int8 part of a file; None for one that carries no plan."""
    loaded = graph.load(path)
    plan = plan_of(loaded)
    if plan is None:
        return None
    ops = [each.op for each in plan.placed]
    return Int8Counts(
        sum(node.op_type == "QuantizeLinear" for node in loaded.graph.all_nodes()),
        len(ops),
        sum(op in WEIGHTED for op in ops),
    )


def save_facts(
    path: Path, facts: Sequence[ModelFacts], about: Mapping[str, object]
) -> None:
    """Write facts, and what they were measured on."""
    rows = _FACTS.dump_python(tuple(facts), mode="json")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {**about, "variants": rows})
    except OSError as error:
        raise StudyError(f"{path}: cannot be written: {error.strerror}") from error


def load_facts(path: Path) -> tuple[dict[str, object], dict[str, ModelFacts]]:
    """Read what `save_facts` wrote: what it was measured on, and facts by variant."""
    try:
        content = documents.from_json(documents.content(path))
        facts = _FACTS.validate_python(content.pop("variants"))
    except OSError as error:
        raise StudyError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, ValidationError, KeyError, AttributeError) as error:
        words = " ".join(str(error).split())[:200]
        raise StudyError(f"{path}: not facts of variants: {words}") from error
    return content, {each.variant: each for each in facts}


def _scaled(samples_us: Iterable[int], scale: float) -> tuple[int, ...]:
    return tuple(round(each * scale) for each in samples_us)
