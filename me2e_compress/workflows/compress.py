"""Compress a model, from file to file."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.errors import PreconditionError, RecipeError
from me2e_compress.fidelity.floor import SQNR_FLOOR_DB, Floor
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager import PassManager, Report
from me2e_compress.manager import recipe as recipes
from me2e_compress.manager.pass_manager import collector_paused
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.fix_shapes import with_sizes
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.rules import RuleSet
from me2e_compress.runtime.latency_trace import cpu_seconds
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.workflows.checks import (
    check_count,
    check_number,
    load_map,
    model_path,
    output_path,
    read_graph,
)
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.compress_fidelity import (
    SplitFrames,
    measure_loss,
    open_frames,
)
from me2e_compress.workflows.compress_result import (
    CompressResult,
    write_result,
    written_files,
)
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.int8_outcome import Int8Outcome
from me2e_compress.workflows.lint import lint_written
from me2e_compress.workflows.listener import SILENT, Listener

Recipe: TypeAlias = str | Path | Sequence[Pass]
"""A shipped recipe's name, a TOML file, or passes."""


@dataclasses.dataclass(frozen=True)
class CompressOptions:
    """How a graph is compressed; None leaves it to the recipe.

    Attributes:
        scheme: int8 after the recipe's passes: ``feature-ext``, ``prediction``,
            ``full``.
        rules: rules of the int8 plan: ``safe``, ``paper``, or a set of yours.
        target: runtime of the int8 graph: ``onnxruntime`` or ``tensorrt``.
        overrides: TOML file of exceptions to the int8 plan.
        ranges: file of saved ranges, instead of frames.
        method: how ranges are read from frames, or were for ``ranges``.
        module_map: preset or TOML file; None finds the preset.
        verify_frames: frames that exact passes are checked on; 0 checks none.
        unproven: write a graph that does not run here, its exact passes unchecked.
        measure_frames: most frames that are kept out of calibration, to measure lossy
            passes on; 0 measures nothing and calibrates on all.
        floor: SQNR in dB below which an output is warned of.
        allow_empty: write the graph although nothing in it became int8.
        dims: sizes that open dimensions of the inputs are given first: ``batch`` to 1.
        adapter: TOML file whose plan and state become metadata of the graph.
        provider: what runs graphs, to calibrate, check and measure.
        force: replace outputs that we did not write, too.
    """

    scheme: str | None = None
    rules: str | RuleSet | None = None
    target: str | None = None
    overrides: str | Path | None = None
    ranges: str | Path | None = None
    method: str | None = None
    module_map: str | Path | None = None
    verify_frames: int = 2
    unproven: bool = False
    measure_frames: int = 8
    floor: float = SQNR_FLOOR_DB
    allow_empty: bool = False
    dims: Mapping[str, int] = dataclasses.field(default_factory=dict)
    adapter: str | Path | None = None
    provider: Provider = CPU
    force: bool = False

    def __post_init__(self) -> None:
        check_count("--verify-frames", self.verify_frames)
        check_count("--measure-frames", self.measure_frames)
        check_number("--floor", self.floor, zero=True)

    def passes(self, recipe: Recipe | None) -> tuple[Pass, ...]:
        """Build the passes of a recipe, with these options' int8.

        Raises:
            RecipeError: There is nothing to do, or the options and passes do not fit.
        """
        # int8 alone comes after the exact recipe
        if isinstance(recipe, str | Path):
            passes = recipes.load(recipe)
        elif recipe is not None:
            passes = tuple(recipe)
        elif self.scheme is not None:
            passes = recipes.load("exact")
        else:
            raise RecipeError(
                f"say what to do: -r RECIPE ({', '.join(recipes.shipped())}), --passes"
                " TEXT or --scheme"
            )
        # a graph is quantized once
        quantizers = [each for each in passes if each.quantizes]
        if len(quantizers) + (self.scheme is not None) > 1:
            raise RecipeError(
                f"{QuantizeInt8.name} is twice in the pipeline, a graph is quantized"
                f" once: leave out {'--scheme' if self.scheme else 'one of them'}"
            )
        if self.scheme is not None:
            passes = (*passes, QuantizeInt8(scheme=self.scheme))
        return self._with_int8(with_sizes(passes, self.dims))

    def _with_int8(self, passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
        """Set options of the passes that quantize, else of those that read ranges."""
        named = ("rules", "target", "method")
        given: dict[str, object] = {n: v for n in named if (v := getattr(self, n))}
        files = {"overrides": self.overrides, "ranges": self.ranges}
        given |= {name: Path(file) for name, file in files.items() if file is not None}
        if not given:
            return passes
        # an option that no pass takes would be ignored without a word
        readers = [each for each in passes if each.quantizes] or [
            each for each in passes if each.reads_ranges
        ]
        known = {name for each in readers for name in each.option_names()}
        if unknown := [name for name in given if name not in known]:
            raise RecipeError(
                f"--{unknown[0].replace('_', '-')} is for int8, and the pipeline has no"
                f" {QuantizeInt8.name}: add --scheme"
            )
        # each reader gets those options that it knows
        return tuple(
            dataclasses.replace(
                each, **{n: v for n, v in given.items() if n in each.option_names()}
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
    passes = options.passes(recipe)
    read = [file for each in passes for file in each.files()]
    named = recipe if isinstance(recipe, str | Path) else None
    # claim the outputs first; Python's cycle collector would walk every node
    inputs = (source, named, frames, options.module_map, options.adapter, *read)
    outputs = written_files(output)
    with writing(outputs, inputs, force=options.force), collector_paused():
        loaded = read_graph(source, listener, options.adapter, options.module_map)
        modules = load_map(options.module_map, loaded)
        seen = open_frames(source, loaded, frames)
        split = SplitFrames.of(*seen, passes, options.measure_frames)
        run = Compression(source, output, options, listener)
        return run.compress(loaded, passes, modules, split)


@dataclasses.dataclass(frozen=True)
class Compression:
    """One graph to compress, whose outputs are claimed already."""

    source: Path
    output: Path
    options: CompressOptions
    listener: Listener

    def compress(
        self,
        model: ir.Model,
        passes: tuple[Pass, ...],
        modules: ModuleMap,
        frames: SplitFrames,
    ) -> CompressResult:
        """Try, compress, measure and write; errors are those of :func:`compress`."""
        start, options, listener = cpu_seconds(), self.options, self.listener
        source, provider = self.source, options.provider
        first = partial(try_first, listener=listener, provider=provider)
        first(model, source.name, frames.calibration or frames.samples, file=source)
        # apply the passes, and refuse a result that is unproven or not int8
        context = Context(modules, frames.calibration, provider=provider)
        checked, folder = options.verify_frames, self.output.parent
        manager = PassManager(passes, checked, folder, frames.samples, first)
        report = manager.run(model, context, partial(listener.on_progress, "passes"))
        _refuse_unproven(report, options)
        int8 = Int8Outcome.of(report, context)
        _refuse_empty(int8, options, listener)
        # measure what lossy passes cost, on the frames kept for it
        if report.lossy and frames.measured is not None:
            first(report.model, self.output.name)
        floor = Floor(options.floor)
        loss = measure_loss(report, provider, frames, floor, listener)
        linted = lint_written(report.model, passes, self.output, options.target)
        seconds = cpu_seconds() - start
        return write_result(report, source, self.output, int8, loss, seconds, linted)


def _refuse_unproven(report: Report, options: CompressOptions) -> None:
    """Refuse exact passes that could not be run; who asked for no check gets none."""
    if report.lossy or options.unproven or not options.verify_frames:
        return
    for check in report.unproven:
        raise PreconditionError(
            f"not proven that {', '.join(check.passes)} left the outputs as they were:"
            f" {check.unproven}; nothing is written, --unproven writes it nevertheless"
        )


def _refuse_empty(
    int8: Int8Outcome | None, options: CompressOptions, listener: Listener
) -> None:
    if int8 is None or not int8.empty:
        return
    if not options.allow_empty:
        raise PreconditionError(
            f"{int8.empty}; nothing is written; -r exact writes a graph without int8"
        )
    listener.on_warning(int8.empty)
