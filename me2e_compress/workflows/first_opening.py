"""Open a graph in a separate process first, because onnxruntime may crash on it.

Native code that divides the least integer by -1, or overflows the stack, kills its
process without a message. A graph that survives is remembered by its digest: it is not
tried again on this machine. The process runs ``opening_main.py``, which imports nothing
of this package: so it starts in 0.3 s, not in 1.6.
"""

import contextlib
import hashlib
import signal
import tempfile
from pathlib import Path
from time import perf_counter

import onnx_ir as ir
import onnxruntime as ort
import platformdirs

from me2e_compress import graph
from me2e_compress.calibration.dataset import archive_of
from me2e_compress.errors import GraphError
from me2e_compress.operators.kernels import why_not
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import compiled_or_expanded, unsupported
from me2e_compress.workflows import opening_main
from me2e_compress.workflows.listener import Listener

STAGE = "first opening"
_SCRIPT = Path(opening_main.__file__)
_REFUSED = (0, 1)
"""Exit codes of a script that ended by itself: an exception gives 1."""


def try_first(
    source: ir.Model | Path,
    name: str,
    frames: Frames | None = None,
    *,
    listener: Listener,
    file: Path | None = None,
    provider: Provider = CPU,
) -> None:
    """Open a graph in another process, and run its first frame, if it is new here.

    A graph that onnxruntime refuses, or that cannot be read, passes: whoever opens it
    next reports why. Only the plain CPU is tried: what other providers do to a graph
    does not follow from it. The listener is told how long this took, since no other
    time includes it. ``file`` may hold the very graph that ``source`` is; without
    ``frames`` the graph is only opened.

    Raises:
        GraphError: onnxruntime crashes on the graph; the message has the graph, the
            step and the signal.
    """
    if provider != CPU:
        return
    begun = perf_counter()
    frame = next(iter(frames or ()), None)
    try:
        file = source if isinstance(source, Path) else file
        model = graph.load(source) if isinstance(source, Path) else source
        if unsupported(model):
            return
        ready, needed = compiled_or_expanded(model, compiled=why_not() is None)
    except GraphError:
        return
    # A verdict holds for this graph, onnxruntime and these kernels.
    kernels = ",".join(each.op_type for each in needed)
    key = (graph.digest(model), ort.__version__, CPU.native, *CPU.left_out, kernels)
    folder = platformdirs.user_cache_path("me2e-compress") / "opened"
    verdict = folder / hashlib.sha256("\n".join(key).encode()).hexdigest()
    step = b"opened" if frame is None else b"ran"
    with contextlib.suppress(OSError):
        if verdict.read_bytes() in (step, b"ran"):
            return
    # Run the script on a file of the graph and of its inputs.
    listener.on_progress(STAGE, 0, 1, name)
    with tempfile.TemporaryDirectory(prefix="me2e-opening-") as scratch:
        if file is None or ready is not model:
            file = Path(scratch) / "model.onnx"
            graph.save(ready, file)
        inputs = Path(scratch) / "frame.npz"
        if frame is not None:
            inputs.write_bytes(archive_of(frame.arrays))
        words = [str(file), str(inputs), kernels, *CPU.left_out]
        done = run_script(_SCRIPT, words)
    # Exit codes that the script does not give itself mean a crash.
    if done.returncode not in _REFUSED:
        last = (done.stdout.split() or ["start"])[-1]
        raise GraphError(f"{name}: onnxruntime {_end(done.returncode)} at step {last}")
    if "open" in done.stdout:
        with contextlib.suppress(OSError):  # a home that cannot be written to
            folder.mkdir(parents=True, exist_ok=True)
            write_bytes(verdict, step)
    listener.on_progress(STAGE, 1, 1, f"{name}: {perf_counter() - begun:.1f} s")


def _end(code: int) -> str:
    """Describe how a process died."""
    if code == -signal.SIGKILL:
        return "was killed (out of memory?)"
    if code < 0:
        names = {each.value: each.name for each in signal.Signals}
        return f"dies of it ({names.get(-code, f'signal {-code}')})"
    return f"dies of it (exit code {code})"
