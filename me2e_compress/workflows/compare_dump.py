"""Hold what an engine answered elsewhere against its graph, and split what was lost."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.engine_dump import EngineDump
from me2e_compress.driving.adapter.outputs import adapted
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.fidelity.engine_loss import EngineRun, OutputLoss, losses
from me2e_compress.fidelity.first_difference import (
    FirstDifference,
    first_difference_of_engine,
)
from me2e_compress.fidelity.floor import ALIVE
from me2e_compress.registry import documents
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.shipped.drivers import SHIPPED, shipped
from me2e_compress.targets.quantized import describe_quantized
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.compress_result import beside
from me2e_compress.workflows.first_difference import headline_of, with_modules
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Status, Table, counted, number, table

SAME_DB = 60.0
"""Above, two float32 programs differ by the order of their sums (60 dB: 0.1 %)."""


@dataclasses.dataclass(frozen=True, repr=False)
class DumpResult(Result):
    """What an engine lost, split into quantization and compilation.

    Attributes:
        graph: The graph that the engine was built from.
        dump: What it answered.
        float_graph: The float source; None if none is known, for `float_reason`.
        state: Whose state the graph was fed: the engine's, our own run's, or none.
        notes: What is no fault and worth knowing.
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

    @property
    def headline(self) -> str:
        """Whether compilation lost anything."""
        worst = min(self.outputs, key=lambda each: each.compilation_db)
        if worst.compilation_db >= SAME_DB:
            return (
                "the engine answers as its graph does"
                f" (least: {worst.name}, {worst.compilation_db:.1f} dB)"
            )
        return (
            "compilation: the engine, or its host, does not answer as its graph does"
            f" (least: {worst.name}, {worst.compilation_db:.1f} dB)"
        )

    def lines(self) -> tuple[str, ...]:
        """Return the verdict, what differs inside, and what is worth knowing."""
        inside = () if self.inner is None else (f"inside: {headline_of(self.inner)}",)
        return (self.headline, *inside, *self.notes)

    def alerts(self) -> tuple[str, ...]:
        """Return the outputs that hardly move, where they should, in words."""
        return tuple(each.dead for each in self.outputs if each.dead)

    @property
    def status(self) -> Status:
        """``refused`` if an output of the engine is dead."""
        return "refused" if self.alerts() else "ok"

    def check(self) -> None:
        """Raise EvaluationError if an output of the engine is dead."""
        if dead := self.alerts():
            raise EvaluationError(f"{self.dump}: {'; '.join(dead)}")

    def tables(self) -> tuple[Table, ...]:
        """Return one row per output."""
        rows = [
            (
                each.name,
                number(each.quantization_db, ".1f"),
                number(each.compilation_db, ".1f"),
                number(each.all_db, ".1f"),
                number(each.moves, ".2f"),
            )
            for each in self.outputs
        ]
        source = (
            f"Quantization is not measured: {self.float_reason}."
            if self.float_graph is None
            else f"Float source: {self.float_graph}."
        )
        note = f"SQNR in dB; moves: a share of what it should; state: {self.state}. "
        columns = ("output", "quantization", "compilation", "all", "moves")
        title = f"What the engine lost over {counted(self.frames, 'frame')}"
        return (table(title, columns, rows, note + source),)


def compare_dump(
    model: str | Path,
    dump: str | Path,
    frames: str | Path,
    listener: Listener = SILENT,
    *,
    float_graph: str | Path | None = None,
    alive: float = ALIVE,
    provider: Provider = CPU,
    adapter: str | Path | None = None,
    module_map: str | Path | None = None,
) -> DumpResult:
    """Hold what an engine answered over frames against the graph it was built from.

    The graph's nodes run as they are written: int8 is simulated. It is fed the state
    that the engine gave, where the dump has it, so that each frame is judged by itself;
    else that of its own run. ``float_graph`` None looks for the source that the report
    beside the graph names. Below ``alive`` of the movement that it should have, an
    output is dead.

    Raises:
        GraphError: A model does not exist or run.
        FramesError: A frame does not fit the graph; the dump cannot be read, or is of
            other frames.
        ProviderError: The provider is not available.
        EvaluationError: The dump is of another graph, or an output is not finite or has
            another shape.
    """
    path = model_path(model)
    recording, answered = CalibrationSet(Path(frames)), EngineDump(dump)
    answered.check(recording)
    loaded = graph.load(path)
    said = adapted(loaded, adapter, module_map)
    recording.check(loaded)
    notes, inner = _checked_names(answered, path, loaded), None
    try_first(
        loaded, path.name, recording, listener=listener, file=path, provider=provider
    )
    session = Session(path, optimize=False, release=True, provider=provider, said=said)
    run = EngineRun(session, recording, answered)
    source, why = _float_source(path, loaded, float_graph)
    opened = None
    if source is not None:
        opened = Session(source, release=True, provider=provider, said=said)
    total = len(recording)
    try:
        outputs = losses(
            run, opened, alive, lambda at: listener.on_progress("frames", at, total, "")
        )
    except EvaluationError as error:
        raise EvaluationError(f"{answered.path}: {error}") from error
    if set(answered.names) - set(session.outputs):
        named = with_modules(loaded)
        inner = first_difference_of_engine(named, run, provider)
    return DumpResult(
        path, answered.path, source, why, total, _state(run), outputs,
        (*notes, *_rounded(run)), inner,
    )  # fmt: skip


def _checked_names(dump: EngineDump, path: Path, loaded: ir.Model) -> tuple[str, ...]:
    """Check that the dump is of this graph; return what of it is not compared."""
    outputs = [str(each.name) for each in loaded.graph.outputs]
    if not set(outputs) & set(dump.names):
        raise EvaluationError(
            f"{dump.path}: answers {', '.join(dump.names)}; {path} gives"
            f" {', '.join(outputs)}: the dump is of another graph"
        )
    made = {value.name for node in loaded.graph for value in node.outputs}
    known = {*made, *outputs}
    if unknown := [each for each in dump.names if each not in known]:
        raise EvaluationError(
            f"{dump.path}: {unknown[0]} is no tensor of {path}, whose outputs"
            f" are {', '.join(outputs)}"
        )
    lacking = [each for each in outputs if each not in dump.names]
    return (f"not dumped: {', '.join(lacking)}",) if lacking else ()


def _float_source(
    path: Path, loaded: ir.Model, given: str | Path | None
) -> tuple[Path | None, str]:
    """Return the float source of a graph, or why none is known."""
    if given is not None:
        return model_path(given), ""
    if describe_quantized(loaded) is None:
        return None, f"{path.name} is not quantized"
    report = beside(path, "report")
    if not report.is_file():
        return None, f"there is no {report.name}, and --float names no source"
    with documents.reading(report, GraphError, "not a report"):
        content = documents.from_json(documents.content(report))
    record = content.get("source") if isinstance(content, dict) else None
    named = record if isinstance(record, dict) else {}
    file, digest = str(named.get("file", "")), named.get("sha256")
    shipped_files = [shipped(each) for each in SHIPPED if f"{each}.onnx" == file]
    for candidate in (path.with_name(file or "."), Path(file), *shipped_files):
        if candidate.is_file() and graph.sha256_of(candidate) == digest:
            return candidate, ""
    return None, f"{file or 'the source'} of {report.name} is not here: give --float"


def _state(run: EngineRun) -> str:
    pairs = run.session.recurrent
    own = [name for name, output in pairs.items() if output not in run.names]
    if not pairs:
        return "none"
    if not own:
        return "the engine's own, so each frame is judged by itself"
    if len(own) == len(pairs):
        return "of our own run, since the dump has none"
    return f"the engine's own, but {', '.join(own)} of our own run"


def _rounded(run: EngineRun) -> Iterator[str]:
    """Say which outputs were rounded to fewer bits: no fault, but worth knowing."""
    found = dict[str, list[str]]()
    for name in run.names:
        value = run.dump[0][name]
        if value.dtype == np.float16:
            found.setdefault("float16", []).append(name)
        elif value.dtype == np.float32 and value.any():
            for kind, lost in (("float16", None), ("bfloat16", 0xFFFF)):
                if _is_rounded(value, lost):
                    found.setdefault(kind, []).append(name)
                    break
    for kind, names in found.items():
        yield f"rounded to {kind}, no fault: {', '.join(names)}"


def _is_rounded(value: Array, lost: int | None) -> bool:
    if lost is not None:
        return not (np.ascontiguousarray(value).view(np.uint32) & lost).any()
    with np.errstate(over="ignore"):
        return bool(np.array_equal(value, value.astype(np.float16).astype(np.float32)))
