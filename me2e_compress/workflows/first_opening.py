"""Open a graph in a separate process first, because onnxruntime may crash on it.

Native code that divides the least integer by -1, or overflows the stack, kills its
process without a message. The verdict on a graph is stored by its digest: the same
graph is not tried again on this machine. The process runs ``opening_main.py``, which
imports nothing of this package: so it starts in 0.3 s, not in 1.6. What the graph
answered there is handed back, so that nobody has to open and run it again for that.
"""

import contextlib
import dataclasses
import hashlib
import json
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter

import onnx_ir as ir
import onnxruntime as ort
import platformdirs

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.operators.kernels import why_not
from me2e_compress.runtime.atomic import write_json
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Array, Frame, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import compiled_or_expanded, unsupported
from me2e_compress.targets.quantized import describe_quantized
from me2e_compress.workflows import opening_main
from me2e_compress.workflows.listener import Listener

STAGE = "first opening"
_SCRIPT = Path(opening_main.__file__)
_SURVIVED = {"onnxruntime": ort.__version__, "survived": True}
_REFUSED = (0, 1)
"""Exit codes of a script that ended by itself: an exception gives 1."""


@dataclasses.dataclass(frozen=True)
class FirstRun:
    """What opening a graph in a separate process gave.

    Attributes:
        seconds: how long it took.
        answers: its outputs, frame by frame; None where they are not those that a
            session here would give: it did not run, lacked an input, or is int8.
    """

    seconds: float
    answers: tuple[Mapping[str, Array], ...] | None = None


def try_first(
    model: ir.Model,
    name: str,
    frames: Frames | Sequence[Frame] | None = None,
    *,
    listener: Listener,
    file: Path | None = None,
    count: int = 1,
    provider: Provider = CPU,
) -> tuple[Mapping[str, Array], ...] | None:
    """Open a graph in another process, if it is new here, and run its first frames.

    `file` holds the same graph as `model`; without `frames` the graph is only opened,
    else it runs the first `count`. The listener is told how long this took, since no
    other time includes it. Providers other than the plain CPU are not tried: what they
    do to a graph does not follow from it.

    Returns:
        What it answered on those frames; None where it was not run for that.

    Raises:
        GraphError: onnxruntime crashes on the graph.
    """
    if provider != CPU:
        return None
    fed = () if frames is None else tuple(islice(frames, count))
    begins = partial(listener.on_progress, STAGE, 0, 1, name)
    found = try_apart(model, name, file=file, frames=fed, on_begin=begins)
    if found is None:
        return None
    listener.on_progress(STAGE, 1, 1, f"{name}: {found.seconds:.1f} s")
    return found.answers


def try_file(file: Path, listener: Listener, provider: Provider = CPU) -> None:
    """Open the graph of a file in another process."""
    if provider != CPU:
        return
    try:
        model = graph.load(file)
    except GraphError:
        return  # who opens it says what is wrong
    try_first(model, file.name, listener=listener, file=file)


def try_apart(
    model: ir.Model,
    name: str,
    *,
    file: Path | None = None,
    frames: Sequence[Frame] = (),
    memory: Path | None = None,
    on_begin: Callable[[], None] = lambda: None,
) -> FirstRun | None:
    """Open a graph, and run frames, in a separate process, unless it is known.

    Opening takes 0.3 s more than a session takes; running adds the inferences. A graph
    that onnxruntime refuses passes here: whoever opens it next reports why. ``file``
    may hold this very graph already. ``frames`` are run in order, as a replay does;
    without them the graph is only opened. ``memory`` is the folder of verdicts, by
    default in the user's cache. Returns None for a known graph.

    Raises:
        GraphError: the process died; the message has the graph, the step and the
            signal.
    """
    begun = perf_counter()
    # What cannot run is refused later, with a reason.
    if unsupported(model):
        return None
    try:
        ready, needed = compiled_or_expanded(model, compiled=why_not() is None)
    except GraphError:
        return None
    # A verdict holds for this graph, onnxruntime and these kernels.
    kernels = [each.op_type for each in needed]
    folder = memory or platformdirs.user_cache_path("me2e-compress") / "opened"
    opened, ran = (folder / f"{each}.json" for each in _fingerprints(model, kernels))
    verdict = ran if frames else opened
    if _is_known(verdict) or _is_known(ran):
        return None
    on_begin()
    # Run the script on a file of the graph and of its inputs.
    with tempfile.TemporaryDirectory(prefix="me2e-opening-") as scratch:
        state = _state(model)
        _save(frames, state or {}, Path(scratch))
        if file is None or ready is not model:
            file = Path(scratch) / "model.onnx"
            graph.save(ready, file)
        words = [str(file), scratch, ",".join(kernels), *CPU.left_out]
        done = run_script(_SCRIPT, words)
        answers = None
        complete = state is not None and _are_complete(model, frames, state)
        if complete and not describe_quantized(model):  # int8 kernels ran there
            answers = _answers(len(frames), Path(scratch))
    # Exit codes that the script does not give itself mean a crash.
    if done.returncode not in _REFUSED:
        step = (done.stdout.split() or ["start"])[-1]
        raise GraphError(f"{name}: onnxruntime {_end(done.returncode)} at step {step}")
    if "open" in done.stdout:
        with contextlib.suppress(OSError):  # a home that cannot be written to
            folder.mkdir(parents=True, exist_ok=True)
            write_json(verdict, _SURVIVED)
    return FirstRun(perf_counter() - begun, answers)


def _state(model: ir.Model) -> dict[str, str] | None:
    """Return ``{input: output}`` of what is fed forward; None where a session decides.

    A session may know the shape of an output of which the file says nothing.
    """
    if any(each.shape is None for each in (*model.graph.inputs, *model.graph.outputs)):
        return None
    try:
        return recurrent_inputs(model)
    except GraphError:
        return None


def _are_complete(
    model: ir.Model, frames: Sequence[Frame], state: Mapping[str, str]
) -> bool:
    """Return whether nothing was made up to run the frames: all is there, or state."""
    fed = {str(each.name) for each in model.graph.inputs} - state.keys()
    starts = frames[:1] and frames[0].starts_scene
    return bool(starts) and all(fed <= frame.arrays.keys() for frame in frames)


def _answers(count: int, folder: Path) -> tuple[Mapping[str, Array], ...] | None:
    """Read the outputs of every frame; None where one is missing."""
    files = [folder / f"{index}.answer.npz" for index in range(count)]
    if not all(each.exists() for each in files):
        return None
    return tuple(opening_main.read(each) for each in files)


def _fingerprints(model: ir.Model, kernels: Sequence[str]) -> Iterator[str]:
    """Yield the digests of an opened and of a run graph, for this onnxruntime."""
    how = (CPU.native, *CPU.left_out, *kernels)
    known = (graph.digest(model), ort.__version__, *how)
    for step in ("opened", "ran"):
        yield hashlib.sha256("\n".join((*known, step)).encode()).hexdigest()


def _save(frames: Sequence[Frame], state: Mapping[str, str], folder: Path) -> None:
    """Write what the script is to run."""
    starts = [frame.starts_scene for frame in frames]
    write_json(folder / "steps.json", {"starts": starts, "recurrent": dict(state)})
    for index, frame in enumerate(frames):
        opening_main.write(folder / f"{index}.npz", frame.arrays)


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
