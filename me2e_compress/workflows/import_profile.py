"""Latencies that were measured elsewhere, by another tool, as a trace of a model."""

from collections.abc import Sequence
from pathlib import Path

from me2e_compress import graph
from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.deadlines import BUDGET_MS
from me2e_compress.runtime.imported_latency import read_imports
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.deadlines_table import check_budget
from me2e_compress.workflows.profile import ProfileOptions
from me2e_compress.workflows.profile_result import ProfileResult


def import_profile(
    model: str | Path,
    files: Sequence[str | Path],
    output: str | Path | None = None,
    *,
    budget_ms: float = BUDGET_MS,
    force: bool = False,
) -> ProfileResult:
    """Read what other tools measured; nothing is run.

    Args:
        model: that was measured: the trace is of this file.
        files: times and profile of trtexec, the log of tegrastats, or a trace; or
            folders of them.
        output: write the latencies as a trace, which ``evaluate`` can charge.
        budget_ms: what a decision may take.
        force: replace an output that is not as we left it, too.

    Raises:
        GraphError: no such model, or the output would harm an input.
        EvaluationError: a file is missing, broken or of another kind, or there is no
            latency in any.
    """
    check_budget(budget_ms)
    if not files:
        raise EvaluationError("--import: there is no file")
    source, written = model_path(model), None if output is None else Path(output)
    read = [file for path in files for file in _files(Path(path))]
    with writing([written], (source, *read), force=force):
        found = read_imports(read)
        machine = found.machine or " and ".join(found.sources)
        trace = LatencyTrace(graph.sha256_of(source), machine, found.samples_us)
        if written is not None:
            trace.save(written)
    return ProfileResult(
        source,
        trace,
        written,
        operators_us=found.layers_us,
        budget_ms=budget_ms,
        told=found.power,
    )


def _files(path: Path) -> list[Path]:
    """Return the files of a folder, or the one file."""
    if not path.is_dir():
        return [path]
    found = [each for each in sorted(path.iterdir()) if each.is_file()]
    if not found:
        raise EvaluationError(f"{path}: there is no file in it")
    return found


def refuse_both(frames: Path | None, options: ProfileOptions) -> None:
    """Refuse to measure where latencies are imported.

    Raises:
        EvaluationError: Something that is asked for would have to be run.
    """
    asked = {
        "FRAMES": frames,
        "--samples": options.samples,
        "--by-module": options.by_module,
        "--figure": options.figure,
        "--energy": options.energy,
        "--adapter": options.adapter,
    }
    for name, value in asked.items():
        if value not in (None, False):
            raise EvaluationError(f"--import runs nothing: leave {name} out")
