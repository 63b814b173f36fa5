"""Compare an engine's dumped outputs with its graph, and split the loss."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.base.display import format_number, plural, table
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.engine_dump import EngineDump
from me2e_compress.commands.checks import model_path, opened
from me2e_compress.commands.compare import headline_of, stamp_modules
from me2e_compress.commands.options import CompareOptions
from me2e_compress.commands.result import Result, View
from me2e_compress.fidelity.engine_loss import (
    EngineRun,
    FirstDifference,
    OutputLoss,
    first_difference_of_engine,
    split_losses,
)
from me2e_compress.runtime.session import Session
from me2e_compress.targets.quantized import describe_quantized

# Above, two float32 programs differ by the order of their sums (60 dB: 0.1 %)
SAME_DB = 60.0


@dataclasses.dataclass(frozen=True, repr=False)
class DumpResult(Result):
    """What an engine lost, split into quantization and compilation.

    Attributes:
        graph: The graph that the engine was built from.
        dump: What it answered.
        float_graph: The float source; None if none is known, for `float_reason`.
        state: Whose state the graph was fed: the engine's own, that of our own run, or
            none.
        notes: What is not compared.
        inner: Where the engine's own tensors begin to differ from the graph's; None if
            the dump has outputs alone.
    """

    graph: Path
    dump: Path
    float_graph: Path | None
    float_reason: str
    frames: int
    state: str
    outputs: tuple[OutputLoss, ...]
    notes: tuple[str, ...]
    inner: FirstDifference | None

    def view(self) -> View:
        """Return what every output lost to what, and where the inside differs."""
        worst = min(self.outputs, key=lambda output: output.compilation_db)
        verdict = "the engine answers as its graph does"
        if worst.compilation_db < SAME_DB:
            verdict = "compilation: the engine, or its host, does not answer as its"
            verdict += " graph does"
        headline = f"{verdict} (least: {worst.name}, {worst.compilation_db:.1f} dB)"
        rows = [
            (
                output.name,
                format_number(output.quantization_db, ".1f"),
                format_number(output.compilation_db, ".1f"),
                format_number(output.all_db, ".1f"),
                format_number(output.moves, ".2f"),
            )
            for output in self.outputs
        ]
        source = (
            f"Quantization is not measured: {self.float_reason}."
            if self.float_graph is None
            else f"Float source: {self.float_graph}."
        )
        note = f"SQNR in dB; moves: a share of what it should; state: {self.state}. "
        columns = ("output", "quantization", "compilation", "all", "moves")
        title = f"What the engine lost over {plural(self.frames, 'frame')}"
        inside = [] if self.inner is None else [f"inside: {headline_of(self.inner)}"]
        dead = tuple(output.dead for output in self.outputs if output.dead)
        return View(
            headline,
            [table(title, columns, rows, note + source)],
            [headline, *inside, *self.notes],
            dead,
            EvaluationError(f"{self.dump}: {'; '.join(dead)}") if dead else None,
        )


def compare_dump(
    model: str | Path,
    dump: str | Path,
    frames: str | Path,
    float_graph: str | Path | None = None,
    options: CompareOptions | None = None,
    listener: Listener = SILENT,
) -> DumpResult:
    """Hold what an engine answered over frames against the graph it was built from.

    The graph's nodes run as they are written: int8 is simulated. It is fed the state
    that the engine gave, where the dump has it, so that each frame is judged by itself;
    else that of its own run. Quantization is measured where ``float_graph`` is given.
    Below the share ``alive`` of the movement that it should have, an output is dead.

    Raises:
        GraphError: A model does not exist or run.
        FramesError: A frame does not fit the graph; the dump cannot be read, or is of
            other frames.
        ProviderError: The provider is not available.
        EvaluationError: The dump is of another graph, or an output is not finite or has
            another shape.
    """
    path, options = model_path(model), options or CompareOptions()
    recording, engine = CalibrationSet(Path(frames)), EngineDump(dump)
    engine.check(recording)
    # The dump must be of this graph; outputs may be missing
    whole = graph.load(path)
    outputs = [str(value.name) for value in whole.graph.outputs]
    if not set(outputs) & set(engine.names):
        raise EvaluationError(
            f"{engine.path}: answers {', '.join(engine.names)}; {path} gives"
            f" {', '.join(outputs)}: the dump is of another graph"
        )
    made = {value.name for node in whole.graph for value in node.outputs}
    if unknown := [name for name in engine.names if name not in {*made, *outputs}]:
        raise EvaluationError(
            f"{engine.path}: {unknown[0]} is no tensor of {path}, whose outputs"
            f" are {', '.join(outputs)}"
        )
    del whole  # it is opened again, with the adapter's metadata
    lacking = [name for name in outputs if name not in engine.names]
    notes = (f"not dumped: {', '.join(lacking)}",) if lacking else ()
    # Run the graph on the engine's state, and its float source beside it
    opening = opened(path, recording, options, listener)
    metadata, provider = opening.metadata, options.runs_on
    session = Session(
        path, optimize=False, release=True, provider=provider, metadata=metadata
    )
    run = EngineRun(session, recording, engine)
    source, original, float_reason = None, None, ""
    if float_graph is not None:
        source = model_path(float_graph)
        original = Session(source, release=True, provider=provider, metadata=metadata)
    elif describe_quantized(opening.model) is None:
        float_reason = f"{path.name} is not quantized"
    else:
        float_reason = "--float names no source"
    total = len(recording)
    try:
        losses = split_losses(
            run,
            original,
            options.alive,
            lambda at: listener.on_progress("frames", at, total, ""),
        )
    except EvaluationError as error:
        raise EvaluationError(f"{engine.path}: {error}") from error
    # Tensors inside show where the engine begins to differ
    inner = None
    if set(engine.names) - set(session.outputs):
        named = stamp_modules(opening.model)
        inner = first_difference_of_engine(named, run, provider)
    # State that the dump lacks is that of our own run
    state, pairs = "none", session.recurrent
    if pairs:
        own = [name for name, output in pairs.items() if output not in run.names]
        state = f"of our own run: {', '.join(own)}" if own else "the engine's own"
    return DumpResult(
        graph=path,
        dump=engine.path,
        float_graph=source,
        float_reason=float_reason,
        frames=total,
        state=state,
        outputs=losses,
        notes=notes,
        inner=inner,
    )
