"""Import latencies that another tool measured, as a trace of a model."""

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

    `files` are times and profile of trtexec, the log of tegrastats, traces, or folders
    of them. `output` is a trace of this very model file, which ``evaluate`` can charge.

    Raises:
        GraphError: The model does not exist, or the output would harm an input.
        EvaluationError: A file is missing or malformed, or none has a latency.
    """
    check_budget(budget_ms)
    if not files:
        raise EvaluationError("--import: there is no file")
    # a folder stands for all of its files
    source, written = model_path(model), None if output is None else Path(output)
    read = [file for path in files for file in _files(Path(path))]
    with writing([written], (source, *read), force=force):
        found = read_imports(read)
        # the trace belongs to the very file that was measured
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
    if not path.is_dir():
        return [path]
    found = [each for each in sorted(path.iterdir()) if each.is_file()]
    if not found:
        raise EvaluationError(f"{path}: there is no file in it")
    return found


def refuse_both(frames: Path | None, options: ProfileOptions) -> None:
    """Refuse options that measure where latencies are imported."""
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
