"""Open a graph in a separate process first, because onnxruntime may crash on it.

Native code that divides the least integer by -1, or overflows the stack, kills its
process without a message. The verdict on a graph is stored by its digest: the same
graph is not tried again on this machine. The process runs ``opening_main.py``, which
imports nothing of this package: so it starts in 0.3 s, not in 1.6.
"""

import contextlib
import hashlib
import json
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
import onnx_ir as ir
import onnxruntime as ort
import platformdirs

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph import LoadedModel
from me2e_compress.operators.kernels import why_not
from me2e_compress.runtime.atomic import write_json
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Array, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import compiled_or_expanded, unsupported
from me2e_compress.workflows.listener import Listener

STAGE = "first opening"
_SCRIPT = Path(__file__).with_name("opening_main.py")
_SURVIVED = {"onnxruntime": ort.__version__, "survived": True}
_REFUSED = (0, 1)
"""Exit codes of a script that ended by itself: an exception gives 1."""


def try_first(
    model: ir.Model,
    name: str,
    listener: Listener,
    *,
    file: Path | None = None,
    frames: Frames | None = None,
    provider: Provider = CPU,
) -> None:
    """Open a graph in another process, if it is new here, and run its first frame.

    `file` holds the same graph as `model`; without `frames` the graph is only opened.
    The listener is told how long this took, since no other time includes it. Providers
    other than the plain CPU are not tried: what they do to a graph does not follow from
    it.

    Raises:
        GraphError: onnxruntime crashes on the graph.
    """
    if provider != CPU:
        return
    first = None if frames is None else next(iter(frames), None)
    feeds = None if first is None else first.arrays
    begins = partial(listener.on_progress, STAGE, 0, 1, name)
    seconds = try_apart(model, name, file=file, feeds=feeds, on_begin=begins)
    if seconds:
        listener.on_progress(STAGE, 1, 1, f"{name}: {seconds:.1f} s")


def try_model(
    loaded: LoadedModel,
    listener: Listener,
    provider: Provider = CPU,
    frames: Frames | None = None,
) -> None:
    """Open a model in another process, and run its first frame; see :func:`try_first`.

    Of a stack the joined graph, and that for first frames, are opened and not run.
    """
    name, stack = loaded.path.name, loaded.stack
    opened = partial(try_first, listener=listener, provider=provider)
    if stack is None:
        opened(loaded.model, name, file=loaded.path, frames=frames)
        return
    for each in filter(None, (stack.model, stack.first)):
        opened(each, name)


def try_file(file: Path, listener: Listener, provider: Provider = CPU) -> None:
    """Open the graph of a file, or both of a stack, in another process."""
    if provider != CPU:
        return
    try:
        loaded = LoadedModel.load(file)
    except GraphError:
        return  # who opens it says what is wrong
    try_model(loaded, listener)


def try_apart(
    model: ir.Model,
    name: str,
    *,
    file: Path | None = None,
    feeds: Mapping[str, Array] | None = None,
    memory: Path | None = None,
    on_begin: Callable[[], None] = lambda: None,
) -> float:
    """Open a graph, and run it once, in a separate process, unless it is known.

    Opening takes 0.3 s more than a session takes; running adds one inference. A graph
    that onnxruntime refuses passes here: whoever opens it next reports why. ``file``
    may hold this very graph already. ``feeds`` are inputs for one run, without which
    the graph is only opened; recurrent ones may be missing. ``memory`` is the folder of
    verdicts, by default in the user's cache. Returns the seconds taken, 0 for a known
    graph.

    Raises:
        GraphError: the process died; the message has the graph, the step and the
            signal.
    """
    begun = perf_counter()
    # What cannot run is refused later, with a reason.
    if unsupported(model):
        return 0.0
    try:
        ready, needed = compiled_or_expanded(model, compiled=why_not() is None)
    except GraphError:
        return 0.0
    # A verdict holds for this graph, onnxruntime and these kernels.
    kernels = [each.op_type for each in needed]
    folder = memory or platformdirs.user_cache_path("me2e-compress") / "opened"
    opened, ran = (folder / f"{each}.json" for each in _fingerprints(model, kernels))
    verdict = opened if feeds is None else ran
    if _is_known(verdict) or _is_known(ran):
        return 0.0
    on_begin()
    # Run the script on a file of the graph and of its inputs.
    with tempfile.TemporaryDirectory(prefix="me2e-opening-") as scratch:
        inputs = Path(scratch) / "inputs.npz"
        _save(feeds or {}, inputs)
        if file is None or ready is not model:
            file = Path(scratch) / "model.onnx"
            graph.save(ready, file)
        steps = "open" if feeds is None else "run"
        words = [str(file), str(inputs), steps, ",".join(kernels), *CPU.left_out]
        done = run_script(_SCRIPT, words)
    # Exit codes that the script does not give itself mean a crash.
    if done.returncode not in _REFUSED:
        step = (done.stdout.split() or ["start"])[-1]
        raise GraphError(f"{name}: onnxruntime {_end(done.returncode)} at step {step}")
    if "open" in done.stdout:
        with contextlib.suppress(OSError):  # a home that cannot be written to
            folder.mkdir(parents=True, exist_ok=True)
            write_json(verdict, _SURVIVED)
    return perf_counter() - begun


def _fingerprints(model: ir.Model, kernels: Sequence[str]) -> Iterator[str]:
    """Yield the digests of an opened and of a run graph, for this onnxruntime."""
    how = (CPU.native, *CPU.left_out, *kernels)
    known = (graph.digest(model), ort.__version__, *how)
    for step in ("opened", "ran"):
        yield hashlib.sha256("\n".join((*known, step)).encode()).hexdigest()


def _save(feeds: Mapping[str, Array], path: Path) -> None:
    """Write arrays by number, and their names first, so that any name is allowed."""
    np.savez(path, np.array(list(feeds), np.str_), *feeds.values(), allow_pickle=False)


def _is_known(verdict: Path) -> bool:
    """Return whether the graph survived before; unreadable verdicts do not count."""
    try:
        found: object = json.loads(verdict.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return found == _SURVIVED


def _end(code: int) -> str:
    """Describe how a process died."""
    if code == -signal.SIGKILL:
        return "was killed (out of memory?)"
    if code < 0:
        names = {each.value: each.name for each in signal.Signals}
        return f"dies of it ({names.get(-code, f'signal {-code}')})"
    return f"dies of it (exit code {code})"
