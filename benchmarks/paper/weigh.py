"""Weigh the files of the paper's variants: size, int8 parts, latency and energy."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from benchmarks.paper.drives import (
    FILE,
    SCHEMES,
    Int8Counts,
    KeptFacts,
    ModelFacts,
)
from benchmarks.paper.evidence import FEWEST_RUNS
from me2e_compress import graph
from me2e_compress.base.errors import StudyError
from me2e_compress.base.listener import Listener
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.inspect import inspect
from me2e_compress.commands.options import InspectOptions, ProfileOptions
from me2e_compress.commands.profile import profile
from me2e_compress.graph import WEIGHTED
from me2e_compress.quantization.decision import plan_of
from me2e_compress.runtime.energy.meter import measure_energy
from me2e_compress.runtime.profile import record_traces
from me2e_compress.runtime.providers import CPU
from me2e_compress.study.definition import Study
from me2e_compress.study.outcome import Clock, this_machine
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.run import StudyCells

PROFILED = 100
"""Inferences under a profiler, for the figure of modules."""
RUN_SAMPLES = 50
"""Inferences a model in one of the separated runs whose medians are compared."""


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


def weigh(
    setup: StudyCells,
    prepared: Sequence[PreparedVariant],
    others: Sequence[ModelFacts],
) -> None:
    """Keep facts of every variant, and a profile of the baseline, unless known.

    ``others`` are facts about other stacks' files, for table 4.
    """
    study, clock, listener = setup.study, setup.clock, setup.listener
    path = setup.workspace.folder / "records" / FILE
    known = KeptFacts.load(path).by_variant if path.is_file() else {}
    found = list[ModelFacts]()
    for done, each in enumerate(prepared):
        listener.on_progress("weigh", done, len(prepared), each.variant.name)
        facts = _facts_of(each, clock, known)
        if each.variant is study.reference and not facts.modules_us:
            facts = replace(facts, modules_us=_by_module(study, each, clock, listener))
        found.append(facts)
    found = _with_runs(study, prepared, found, clock, listener)
    found = [*_with_joules(study, prepared, found, listener), *others]
    # what is known of other files stays known
    names = [each.variant for each in found]
    more = [each for name, each in known.items() if name not in names]
    KeptFacts(clock.scale, (*found, *more), this_machine(clock.load)).save(path)


def _facts_of(
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
    if before and before.sha256 == prepared.sha256:
        return (
            before
            if before.latency_us == latency_us
            else replace(before, latency_us=latency_us, modules_us={}, runs_us=())
        )
    # otherwise count the graph anew
    module_map = prepared.variant.module_map
    found = inspect(prepared.model, InspectOptions(module_map=module_map))
    return ModelFacts(
        name,
        prepared.sha256,
        prepared.pipeline,
        prepared.size_bytes,
        sum(each.parameters for each in found.modules),
        found.macs,
        int8_counts(prepared.model),
        latency_us,
    )


def _with_runs(
    study: Study,
    prepared: Sequence[PreparedVariant],
    found: Sequence[ModelFacts],
    clock: Clock,
    listener: Listener,
) -> list[ModelFacts]:
    """Time all models in separated runs, each time with sessions opened anew.

    Models with a trace from a device are not timed here.
    """
    models = {
        each.variant.name: each.model
        for each in prepared
        if each.model is not None and not each.variant.trace
    }
    known = {each.variant for each in found if len(each.runs_us) >= FEWEST_RUNS}
    if study.held_out is None or known.issuperset(models):
        return list(found)
    runs: dict[str, list[int]] = {name: [] for name in models}
    for done in range(FEWEST_RUNS):
        listener.on_progress("runs", done, FEWEST_RUNS, "")
        traces = record_traces(
            models,
            CalibrationSet(study.held_out),
            samples=RUN_SAMPLES,
            threads=study.timing.threads,
            provider=study.provider,
        )
        for name, trace in traces.items():
            runs[name].extend(_scaled([trace.percentile_us(50)], clock.scale))
    return [replace(e, runs_us=tuple(runs.get(e.variant, e.runs_us))) for e in found]


def _with_joules(
    study: Study,
    prepared: Sequence[PreparedVariant],
    found: Sequence[ModelFacts],
    listener: Listener,
) -> list[ModelFacts]:
    """Measure joules per frame if this machine has a counter."""
    # models whose energy is not known yet
    models = {
        each.variant.name: each.model
        for each, facts in zip(prepared, found, strict=True)
        if each.model is not None and facts.joules is None
    }
    if study.held_out is None or not models:
        return list(found)
    # all models are measured in one run
    measured = measure_energy(
        models,
        CalibrationSet(study.held_out),
        threads=study.timing.threads,
        provider=study.provider,
        on_window=partial(listener.on_progress, "energy"),
    )
    return [
        each.with_energy(measured[each.variant]) if each.variant in measured else each
        for each in found
    ]


def _by_module(
    study: Study, prepared: PreparedVariant, clock: Clock, listener: Listener
) -> dict[str, tuple[int, ...]]:
    """Profile a model, on the scale of the device."""
    on_cpu = study.provider.native == CPU.native  # elsewhere nodes are not timed
    if prepared.model is None or study.held_out is None or not on_cpu:
        return {}
    options = ProfileOptions(
        samples=PROFILED,
        by_module=True,
        module_map=prepared.variant.module_map,
        threads=study.timing.threads,
    )
    trace = profile(prepared.model, study.held_out, None, options, listener).trace
    return {
        module: _scaled(samples, clock.scale)
        for module, samples in trace.modules_us.items()
    }


def _scaled(samples_us: Iterable[int], scale: float) -> tuple[int, ...]:
    return tuple(round(each * scale) for each in samples_us)
