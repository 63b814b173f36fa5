"""Compress a model, from file to file."""

import dataclasses
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import onnx

from me2e_compress import graph
from me2e_compress.base import atomic
from me2e_compress.base.atomic import write_document
from me2e_compress.base.display import format_mb
from me2e_compress.base.errors import (
    FramesError,
    GraphError,
    PreconditionError,
    RecipeError,
)
from me2e_compress.base.extras import missing_module
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.calibration.ranges import GUARD_ADVICE
from me2e_compress.commands.checks import (
    load_map,
    model_path,
    output_path,
    read_graph,
    try_first,
    writing,
)
from me2e_compress.commands.inspect import WEIGHTS
from me2e_compress.commands.lint import LintResult, lint_written
from me2e_compress.commands.options import CompressOptions
from me2e_compress.commands.outcome import (
    Int8Outcome,
    MeasuredLoss,
    measure_loss,
    split_frames,
)
from me2e_compress.commands.result import Result, View, json_ready
from me2e_compress.fidelity.floor import Floor
from me2e_compress.graph import file_bytes
from me2e_compress.graph.files import data_names
from me2e_compress.graph.provenance import drop_traces
from me2e_compress.graph.shapes import records_shapes, without_inferable_shapes
from me2e_compress.manager import PassManager, Report
from me2e_compress.manager import recipe as recipes
from me2e_compress.manager.pass_manager import pause_collector
from me2e_compress.manager.verification_inputs import Answers, seeded_frames
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.fix_shapes import with_sizes
from me2e_compress.passes.freeze_inputs import advice
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.passes.quantize_int8 import QuantizeInt8, Quantizer, quantizes_float
from me2e_compress.quantization.decision import plan_of, save_plan
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.latency_trace import cpu_seconds
from me2e_compress.runtime.providers import CPU, PROVIDERS, Provider
from me2e_compress.runtime.session import Session, replay

Recipe: TypeAlias = str | Path | Sequence[Pass]
"""A shipped recipe's name, a TOML file, or passes."""


@dataclasses.dataclass(frozen=True, repr=False)
class CompressResult(Result):
    """A compressed graph, and how it came to be.

    Attributes:
        output: the file that was written, with ``STEM.report.json`` beside it and,
            where the graph was quantized, ``STEM.plan.json``.
        record: what ``STEM.report.json`` holds.
        source_bytes: size with external weights, as `output_bytes` is.
        int8: what became int8 and what did not; None where no pass quantizes.
        loss: how true the graph stayed; None where every pass is exact.
        seconds: CPU time of everything but the writing.
        larger: of what the file is larger than its source; empty if it is not.
        slower: that int8 for this CPU takes longer than its source, measured on one
            frame; empty if it does not.
        lint: what the target's rules say of the graph; None where nothing is int8.
    """

    source: Path
    output: Path
    report: Report
    record: Mapping[str, object]
    source_bytes: int
    output_bytes: int
    int8: Int8Outcome | None = None
    loss: MeasuredLoss | None = None
    seconds: float = 0.0
    lint: LintResult | None = None
    larger: str = ""
    slower: str = ""

    @property
    def weights(self) -> str:
        """What the metadata says of the graph's checkpoint; empty if nothing."""
        return self.report.model.metadata_props.get(WEIGHTS, "")

    @property
    def size(self) -> str:
        """The size in MB, and its share of the source's."""
        share = self.output_bytes / self.source_bytes
        return f"{format_mb(self.output_bytes)} MB, {share:.1%} of {self.source.name}"

    def view(self) -> View:
        """Return passes and checks, what the outputs lost, time and size.

        An alert says that nothing became int8, that quality is below the floor, or
        that the target refuses the graph or computes it otherwise.
        """
        report = sidecar(self.output, "report")
        headline = f"{self.output}: {self.size}; report: {report}"
        weights = self.weights and f"weights: {self.weights}"
        time = f"took {self.seconds:.0f} CPU s"
        measured = None if self.loss is None else self.loss.table()
        if self.loss is not None and self.loss.fidelity is not None:
            time += f", {self.loss.seconds:.0f} of them to measure"
        time += self.slower and f"; {self.slower}"
        lint = self.lint
        wrong = [] if lint is None else filter(None, (lint.refusal, lint.miscomputed))
        error = None
        if lint is not None and lint.asked and lint.refusal is not None:
            error = PreconditionError(f"written, but {lint.refusal}")
        return View(
            headline,
            (*self.report.tables(), *filter(None, [measured])),
            filter(None, (*self.summary_lines(), time, headline, weights)),
            (
                *(() if self.loss is None else self.loss.alerts()),
                *filter(None, ["" if self.int8 is None else self.int8.why_empty]),
                *(n for s in self.report.steps for n in s.notes if GUARD_ADVICE in n),
                *(f"lint: {line}" for line in wrong),
            ),
            error,
        )

    def summary_lines(self) -> Iterator[str]:
        """Yield lines for people: int8, what is proven or not, loss, lint, size."""
        if self.int8 is not None:
            yield self.int8.line
            yield from filter(None, [self.int8.slow_here])
        # how far exact passes moved the outputs, and what is not proven
        judged = [
            (check.errors[name], check.inputs_text)
            for check in self.report.verifications
            for name in check.judged
        ]
        # with lossy passes in the pipeline, sameness is not the claim
        if judged and not self.report.lossy:
            worst, inputs = max(judged)
            near = f" to within {worst:.1e} of its largest value" if worst else ""
            yield f"every output is the same{near} ({inputs})"
        if not any(step.changes for step in self.report.steps):
            yield "every output is the same: no pass changed anything"
        # what could not be proven is said too
        for check in self.report.verifications:
            if check.unproven is not None:
                yield f"not proven: {', '.join(check.passes)}: {check.unproven}"
            elif check.left_out:
                yield f"not proven of every output: {check.left_out}"
            yield from check.remarks
        if self.loss is not None:
            yield from self.loss.lines()
        if self.lint is not None:
            yield f"lint: {self.lint.headline}"
        yield from filter(None, [self.larger])

    def findings(self) -> dict[str, Any]:
        """Return weights, int8, fidelity and verdict for the report, without times.

        The same run thus writes the same file; numbers that are not finite become null.
        """
        findings = {
            "weights": self.weights,
            "int8": self.int8,
            "fidelity": None if self.loss is None else self.loss.record(),
            "lint": None if self.lint is None else self.lint.summary(),
            "verdict": [*self.summary_lines(), *self.alerts()],
        }
        return {name: json_ready(each) for name, each in findings.items()}

    def to_json(self) -> object:
        """Return the report file's content except the verdict, which `lines` has."""
        return {key: each for key, each in self.record.items() if key != "verdict"}


def passes_of(recipe: Recipe | None, options: CompressOptions) -> tuple[Pass, ...]:
    """Build the passes of a recipe, with int8 as the options say.

    Raises:
        RecipeError: There is nothing to do, or the options and passes do not fit.
    """
    # int8 alone comes after the exact recipe
    if isinstance(recipe, str | Path):
        passes = recipes.load(recipe)
    elif recipe is not None:
        passes = tuple(recipe)
    elif options.scheme is not None:
        passes = recipes.load("exact")
    else:
        raise RecipeError(
            f"say what to do: -r RECIPE ({', '.join(recipes.shipped())}), --passes"
            " TEXT or --scheme"
        )
    # a graph is quantized once
    quantizers = [each for each in passes if quantizes_float(each)]
    if len(quantizers) + (options.scheme is not None) > 1:
        raise RecipeError(
            f"{QuantizeInt8.name} is twice in the pipeline, a graph is quantized"
            f" once: leave out {'--scheme' if options.scheme else 'one of them'}"
        )
    if options.scheme is not None:
        passes = (*passes, QuantizeInt8(scheme=options.scheme))
    return _set_int8(with_sizes(passes, options.dims), options)


def _set_int8(passes: tuple[Pass, ...], options: CompressOptions) -> tuple[Pass, ...]:
    """Return passes with the int8 options set where they quantize, else read ranges."""
    named = ("rules", "target", "method")
    chosen: dict[str, object] = {n: v for n in named if (v := getattr(options, n))}
    files = {"overrides": options.overrides, "ranges": options.ranges}
    chosen |= {name: Path(file) for name, file in files.items() if file is not None}
    if not chosen:
        return passes
    # an option that no pass takes would be ignored without a word
    readers = [each for each in passes if quantizes_float(each)] or [
        each for each in passes if isinstance(each, Quantizer)
    ]
    known = {name for each in readers for name in each.option_names()}
    if unknown := [name for name in chosen if name not in known]:
        raise RecipeError(
            f"--{unknown[0].replace('_', '-')} is for int8, and the pipeline has no"
            f" {QuantizeInt8.name}: add --scheme"
        )
    # each reader gets those options that it knows
    return tuple(
        dataclasses.replace(
            each, **{n: v for n, v in chosen.items() if n in each.option_names()}
        )
        if each in readers
        else each
        for each in passes
    )


def compress(
    model: str | Path,
    output: str | Path,
    recipe: Recipe | None = None,
    frames: str | Path | None = None,
    options: CompressOptions | None = None,
    listener: Listener = SILENT,
) -> CompressResult:
    """Apply passes to a graph, check each, and write the smaller graph and a report.

    The model is an ONNX file, which is not changed, or the name of a model that ships.
    Without frames exact passes are checked on seeded inputs; a model that ships has its
    own frames.

    Raises:
        GraphError: The model does not exist, or the output would harm an input.
        RecipeError: There is nothing to do, or options do not fit the passes.
        FramesError: The frames do not fit the model.
        PreconditionError: Nothing became int8, or exact passes are not proven.
        ProviderError: The provider is not available.
        Me2eError: A pass refused the graph or failed.
    """
    options = options or CompressOptions()
    source, output = model_path(model), output_path(output)
    passes = passes_of(recipe, options)
    read = [file for each in passes for file in each.files()]
    named = recipe if isinstance(recipe, str | Path) else None
    # claim the outputs first; Python's cycle collector would walk every node
    inputs = (source, named, frames, options.module_map, options.adapter, *read)
    reported = sidecar(output, "plan"), sidecar(output, "report")
    outputs = (output, *data_names(output), *reported)
    with writing(outputs, inputs, force=options.force), pause_collector():
        loaded = read_graph(source, listener, options.adapter, options.module_map)
        drop_traces(loaded)
        shaped = records_shapes(loaded)
        modules = load_map(options.module_map, loaded)
        seen = split_frames(source, loaded, frames, passes, options.measure_frames)
        start, provider = cpu_seconds(), options.runs_on
        # the proof reads what the graphs answer as they are opened apart
        checked, answers = options.verify_frames, Answers()
        first = partial(try_first, listener=listener, provider=provider)
        first = partial(first, count=max(1, checked), answers=answers)
        shown: Frames | None = seen.calibration or seen.samples
        if shown is None and checked:
            shown = seeded_frames(loaded, options.seed, checked)
        first(loaded, source.name, shown, file=source)
        # apply the passes, and refuse a result that is unproven or not int8
        context = Context(modules, seen.calibration, options.seed, provider)
        folder = output.parent
        manager = PassManager(passes, checked, folder, seen.samples, first, answers)
        report = manager.run(loaded, context, partial(listener.on_progress, "passes"))
        int8 = Int8Outcome.of(report, context)
        _check_int8(report, int8, options, listener)
        # measure what lossy passes cost, on the frames kept for it
        if report.lossy and seen.measured is not None:
            first(report.model, output.name)
        loss = measure_loss(report, provider, seen, Floor(options.floor), listener)
        linted = lint_written(report.model, passes, output, options.target)
        seconds = cpu_seconds() - start
        sizes = file_bytes(source), 0
        made = CompressResult(
            source, output, report, {}, *sizes, int8, loss, seconds, linted
        )
        made = _write(made, shaped=shaped)
        placed = () if int8 is None or int8.slow_here else report.lossy
        if shown is None or provider.native != CPU.native or not placed:
            return made
        slower = speed_note(source, output, shown, provider)
        return dataclasses.replace(made, slower=slower)


def _check_int8(
    report: Report,
    int8: Int8Outcome | None,
    options: CompressOptions,
    listener: Listener,
) -> None:
    """Raise a PreconditionError of unproven exact passes, or a graph without int8."""
    # who asked for no check gets none
    unproven = () if report.lossy or not options.verify_frames else report.unproven
    for check in unproven:
        raise PreconditionError(
            f"not proven that {', '.join(check.passes)} left the outputs as they were:"
            f" {check.unproven}; nothing is written; --verify-frames 0 writes it"
            " unproven"
        )
    if int8 is None or not int8.why_empty:
        return
    if not options.allow_empty:
        way = advice(report.model) or "-r exact writes a graph without int8"
        raise PreconditionError(f"{int8.why_empty}; nothing is written; {way}")
    listener.on_warning(int8.why_empty)


def sidecar(output: Path, what: str) -> Path:
    """Return the path of the ``plan`` or ``report`` beside a compressed graph."""
    return output.with_name(f"{output.stem}.{what}.json")


def _write(result: CompressResult, *, shaped: bool) -> CompressResult:
    """Write the graph and its plan, then the report, which vouches for both.

    Only a graph whose source has them (``shaped``) gets shapes that can be inferred.
    """
    report, source, output = result.report, result.source, result.output
    model = with_own_domains(report.model)
    model = model if shaped else without_inferable_shapes(model)
    plan = plan_of(report.model)  # before writing: metadata may be malformed
    with atomic.all_or_none():
        graph.save(model, output)
        if plan is not None:
            save_plan(plan, sidecar(output, "plan"))
        size, larger = file_bytes(output), size_note(source, output)
        result = dataclasses.replace(result, output_bytes=size, larger=larger)
        record = report.record(source, output) | result.findings()
        write_document(sidecar(output, "report"), record, indent=2)
    return dataclasses.replace(result, record=record)


ROUNDS = 5
"""Runs of each file, the least of which counts."""
ENOUGH_S = 3.0
"""So long is measured at most, but for the first round."""
WORTH_S = 1e-3
"""Of smaller frames OpenVINO is not asked."""
WORTH_NAMING = 0.9
"""Of the time in onnxruntime, what OpenVINO takes at most where it is named."""


def size_note(source: Path, output: Path) -> str:
    """Return by how much a file is larger than its source, and why; else empty."""
    more = file_bytes(output) - file_bytes(source)
    if more <= 0:
        return ""
    model = onnx.load(output, load_external_data=False)
    notes = [entry for node in model.graph.node for entry in node.metadata_props]
    known = sum(each.ByteSize() for each in (*notes, *model.metadata_props))
    shapes = sum(each.ByteSize() for each in model.graph.value_info)
    return (
        f"{output.name} is {more:,} bytes larger than {source.name}: origins and plan"
        f" take {known:,}, shapes {shapes:,}, the rest are nodes and weights"
    )


def least_cpu_s(runs: Sequence[tuple[Path, Provider]], frame: Frame) -> list[float]:
    """Return the CPU seconds of a frame in each file, in turn; none if one fails."""
    least, begun = [math.inf] * len(runs), time.perf_counter()
    try:
        sessions = [
            Session(path, threads=1, stock=True, provider=p) for path, p in runs
        ]
        for _ in range(1 + ROUNDS):
            for index, session in enumerate(sessions):
                start = time.process_time()
                next(replay(session, [frame]))
                least[index] = min(time.process_time() - start, least[index])
            if time.perf_counter() - begun > ENOUGH_S:
                break
    except (FramesError, GraphError):
        return []
    return least


def speed_note(source: Path, output: Path, frames: Frames, provider: Provider) -> str:
    """Return where a file takes longer than its source here, or OpenVINO takes less.

    CPU time of one frame on one thread, in turn, as anybody opens the files. Empty
    where neither is so, or one of them does not run.
    """
    frame = next(iter(frames))
    least = least_cpu_s([(source, provider), (output, provider)], frame)
    if not least:
        return ""
    # Whether OpenVINO is faster, where it is installed and that matters
    (was, ours), other = least, 1.0
    if ours > WORTH_S and not missing_module("openvino"):
        both = [(output, PROVIDERS.parse("openvino")), (output, provider)]
        faster, slower = least_cpu_s(both, frame) or (1.0, 1.0)
        other = faster / slower
    if other < WORTH_NAMING:
        return (
            f"OpenVINO runs {output.name} in {other:.2f} of the time: --provider"
            " openvino runs it, --target openvino writes what is faster still"
        )
    ratio = ours / was
    if ratio < 1:
        return ""
    return (
        f"{output.name} takes {ratio:.2f} times as long as {source.name} here (CPU time"
        " of one frame, one thread)"
    )
