"""Checks before any work: inputs, outputs, folders, and graphs opened apart.

One rule holds for every command: an existing file is replaced only if it says that
me2e-compress wrote it (:mod:`me2e_compress.base.atomic`), unless forced. A command
that works in a folder which later runs resume holds a lock on that folder. The system
releases it when the process dies, and nothing of it lies in the folder.

A graph is opened in a separate process first, because onnxruntime may crash on it:
native code that divides the least integer by -1, or overflows the stack, kills its
process without a message. A graph that survives is remembered by its digest: it is not
tried again on this machine. The process runs ``opening_main.py``, which imports nothing
of this package: so it starts in 0.3 s, not in 1.6.
"""

import contextlib
import dataclasses
import errno
import fcntl
import functools
import hashlib
import itertools
import json
import os
import signal
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import TypeAlias

import onnx_ir as ir
import onnxruntime as ort
import platformdirs

from me2e_compress import graph
from me2e_compress.base.atomic import is_marked, write_bytes
from me2e_compress.base.display import plural
from me2e_compress.base.errors import GraphError
from me2e_compress.base.listener import Listener
from me2e_compress.calibration.dataset import CalibrationSet, load_arrays, npz_bytes
from me2e_compress.commands import opening_main
from me2e_compress.commands.options import GraphOptions
from me2e_compress.driving.adapter.outputs import state_and_plan, write_port_metadata
from me2e_compress.graph.modules.assign import map_of
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.nodes import draws, is_read, is_standard, nodes_of, opset_of
from me2e_compress.graph.opset import read_as
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.graph.runtime_operators import has_operator
from me2e_compress.graph.shapes import unshaped_plugins
from me2e_compress.manager.verification_inputs import Answers
from me2e_compress.operators.kernels.trampoline import why_not
from me2e_compress.runtime.children import run_script
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import is_fused, replace_fused, why_unsupported
from me2e_compress.shipped.drivers import SHIPPED, is_copy, map_name, shipped_model

Given: TypeAlias = str | Path | None
"""An input as the user names it; a word that does not name a file is harmless."""


def model_path(text: str | Path, folder: Path = Path()) -> Path:
    """Return the file of a path, or else of a shipped name; a GraphError of neither."""
    path = folder / text
    if path.is_file():
        return path
    if str(text) in SHIPPED:
        return shipped_model(str(text))
    raise GraphError(f"{text}: no such file; models that ship: {', '.join(SHIPPED)}")


def load_graph(path: Path) -> ir.Model:
    """Read a graph; refuse one of before opset 7 that onnxruntime cannot run.

    That is the first of which it has all operators (its docs/Versioning.md); before it
    they broadcast by attributes, which onnx 1.23 converts wrongly.
    """
    model = graph.load(path)
    if 0 < (opset := opset_of(model)) < 7:
        used = {node.op_type for node in nodes_of(model) if is_standard(node)}
        if missing := sorted(each for each in used if not has_operator(each, opset)):
            raise GraphError(
                f"{path}: opset {opset}: onnxruntime has no {', '.join(missing)} of"
                " before opset 7: export it again, in 13 or newer"
            )
    return model


def read_graph(
    path: Path, listener: Listener, adapter: Given = None, module_map: Given = None
) -> ir.Model:
    """Read a graph; warn of another opset and of its shortcomings.

    What an adapter and a map state becomes metadata; see `write_port_metadata`.
    """
    model = load_graph(path)
    write_port_metadata(model, adapter, module_map or map_name(path))
    if change := read_as(model):
        listener.on_warning(f"{path}: {change}")
    if hint := shortcomings(model):
        listener.on_warning(f"{path}: {hint}")
    return model


def shortcomings(model: ir.Model) -> str:
    """Name what passes do not see, and inputs that nothing reads; empty if all is well.

    They see neither shapes after unknown plugins nor layers in functions.
    """
    unread = [str(each.name) for each in model.graph.inputs if not is_read(each)]
    idle = f"nothing reads input {', '.join(unread)}" if unread else ""
    hints = _shape_hint(model), _function_hint(model), idle
    return "; ".join(filter(None, hints))


def _function_hint(model: ir.Model) -> str:
    """Describe the layers in functions of the file, by calls; empty without any."""

    @functools.cache
    def layers(node: ir.Node) -> int:
        body = model.functions.get(node.op_identifier())
        inside = () if body is None else body.all_nodes()
        return (node.op_type in _LAYERS and is_standard(node)) + sum(
            map(layers, inside)
        )

    calls = {
        node: layers(node)
        for node in model.graph.all_nodes()
        if node.op_identifier() in model.functions and not is_fused(node)
    }
    if not any(calls.values()):
        return ""
    names = ", ".join(dict.fromkeys(f"{e.domain}::{e.op_type}" for e in calls))
    return (
        f"{plural(sum(calls.values()), 'layer')} in functions of the file ({names}),"
        f" which passes leave as they are; to write them out first: {_INLINE}"
    )


_LAYERS = ("Conv", "ConvTranspose", "Gemm", "MatMul")
_INLINE = (
    "python -c 'import onnx, onnx.inliner as i;"
    ' onnx.save(i.inline_local_functions(onnx.load("M.onnx")), "inlined.onnx")\''
)


def _shape_hint(model: ir.Model) -> str:
    """Describe the plugins whose output shapes are unknown; empty if there are none."""
    if not unshaped_plugins(model):
        return ""
    copy = model.clone()
    graph.infer_shapes(copy)  # plugins of known dialects tell it themselves
    plugins = unshaped_plugins(copy)
    if not plugins:
        return ""
    names = ", ".join(dict.fromkeys(node.op_type for node in plugins))
    return (
        f"{len(plugins)} plugin nodes ({names}) tell no shape of what they give; write"
        " it as value_info of the file, and folding, MACs and int8 go on behind them"
    )


def load_map(named: str | Path | None, model: ir.Model) -> ModuleMap:
    """Load the named module map; None finds the preset that fits the graph."""
    return map_of(model, None if named is None else str(named))


def output_path(named: str | Path) -> Path:
    """Return the path of an output, which must name a file."""
    path = Path(named)
    if path.name in ("", ".."):
        raise GraphError(f"{path} is a folder: name a file for the output")
    return path


def check_output(outputs: Sequence[Path | None], inputs: Iterable[Given]) -> None:
    """Refuse outputs that could not be written, or would harm an input.

    `inputs` are files and folders of frames that are read; the external weights of a
    model are protected as well.

    Raises:
        GraphError: An output is an input, a frame of a recording, a folder or a device,
            is named twice, or its folder does not exist.
    """
    named = dict[Path, Path]()
    # a model may be named by many variants, and is loaded, once, to find its weights
    read = dict.fromkeys(Path(each) for each in inputs if each is not None)
    # an output must be a regular file in an existing folder, and named once
    for output in filter(None, outputs):
        if not output.parent.is_dir():
            raise GraphError(f"{output}: no such folder {output.parent}")
        if output.is_dir():
            raise GraphError(f"{output} is a folder: name a file for the output")
        if output.exists() and not output.is_file():
            raise GraphError(f"{output} is a device or a pipe: name a file")
        if named.setdefault(real_path(output), output) is not output:
            raise GraphError(f"{output} is named for two outputs: choose another name")
    # no input may be overwritten
    for given in read:
        _check_input(list(named.values()), given)


def check_folder(
    folder: Path, inputs: Iterable[Given], files: Sequence[str] = ()
) -> None:
    """Raise a GraphError if it cannot be made, or one of its `files` is an input."""
    read = list(inputs)
    if not real_path(folder).name:
        raise GraphError(f"{folder} is the root of all files: name a folder")
    if folder.exists() and not folder.is_dir():
        raise GraphError(f"{folder} is a file: name a folder for the output")
    if not folder.is_dir():
        return
    for source in (Path(each) for each in read if each is not None):
        if source.is_dir() and folder.samefile(source):
            raise GraphError(f"{folder} is the input: choose another folder")
    check_output([folder / name for name in files], read)


def real_path(path: Path) -> Path:
    """Resolve symbolic links; a path in a circle of links stays as it is."""
    return Path(os.path.realpath(path))


def _check_input(outputs: Sequence[Path], source: Path) -> None:
    """Raise a GraphError for an output that would change an input."""
    weights: Sequence[Path] | None = None
    for output in outputs:
        if source.is_dir():
            inside = real_path(output).parent == real_path(source)
            if inside and (output.suffix == ".npz" or output.name == "scenes.json"):
                raise GraphError(
                    f"{output} would be a frame of the input: choose another name"
                )
        elif output.exists() and source.is_file():
            if output.samefile(source):
                raise GraphError(
                    f"{output} is the input: choose another name for the output"
                )
            weights = list(_weight_files(source)) if weights is None else weights
            if any(output.samefile(file) for file in weights):
                raise GraphError(f"{output} holds the weights of {source}: not written")


def _weight_files(given: Path) -> Iterator[Path]:
    """Yield the external weight files of a model; none for other files."""
    try:
        model = graph.load(given)
    except GraphError:  # not a model, or refused before anything is written
        return
    for each in model.graphs():
        for value in each.initializers.values():
            if isinstance(value.const_value, ir.ExternalTensor):
                yield Path(value.const_value.path)


@contextlib.contextmanager
def writing(
    files: Sequence[Path | None] = (),
    inputs: Iterable[Given] = (),
    *,
    trees: Sequence[Path] = (),
    folders: Sequence[Path] = (),
    force: bool = False,
) -> Iterator[None]:
    """Check outputs, and hold the folders to work in, while they are written.

    Args:
        files: files that are written.
        inputs: files and folders that are read, and must not be overwritten.
        trees: folders that are replaced as a whole.
        folders: folders that one command at a time may work in; they are made if
            needed, and their contents are not checked.
        force: replace files and trees of the user too.

    Raises:
        GraphError: An output belongs to the user, is an input or no regular file, or
            another process works in one of the folders.
    """
    check_output(files, inputs)
    check_replaceable(filter(None, files), trees=trees, force=force)
    with contextlib.ExitStack() as stack:
        for folder in folders:
            stack.enter_context(_lock_folder(folder))
        yield


def check_replaceable(
    files: Iterable[Path], *, trees: Iterable[Path] = (), force: bool = False
) -> None:
    """Raise early the GraphErrors of :func:`writing` on files that exist."""
    existing = [file for file in files if file.parent.is_dir()]
    check_output(existing, ())
    for output in (*existing, *trees):
        # nothing of the user is lost with a file that we wrote, or a copy of what ships
        ours = is_marked(output) or (not output.is_symlink() and is_copy(output))
        if os.path.lexists(output) and not force and not ours:
            raise GraphError(
                f"{output} is there, and me2e-compress did not write it: choose another"
                " name, or replace it by --force"
            )


@contextlib.contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder; a GraphError where another process has locked it."""
    is_new = not folder.is_dir()
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:  # without waiting; file systems without locks grant every one
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EAGAIN):
                raise GraphError(
                    f"{folder} is in use: another me2e-compress works there; wait for"
                    " it, or choose another folder"
                ) from error
        try:
            yield
        finally:
            if is_new:
                with contextlib.suppress(OSError):  # what is not empty stays
                    folder.rmdir()
    finally:
        os.close(handle)


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
    count: int = 1,
    answers: Answers | None = None,
) -> None:
    """Open a graph in another process, and run it on frames, if it is new here.

    It is run on the first ``count``, of one scene; ``answers`` gets what it gave.

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
    shown = list(itertools.islice(frames or (), count))
    shown[1:] = itertools.takewhile(lambda frame: not frame.starts_scene, shown[1:])
    try:
        file = source if isinstance(source, Path) else file
        model = graph.load(source) if isinstance(source, Path) else source
        if why_unsupported(model):
            return
        ready, needed = replace_fused(model, compiled=why_not() is None)
    except GraphError:
        return
    # A verdict holds for this graph, onnxruntime and these kernels.
    kernels = ",".join(each.op_type for each in needed)
    key = (graph.digest(model), ort.__version__, CPU.native, *CPU.left_out, kernels)
    folder = platformdirs.user_cache_path("me2e-compress") / "opened"
    verdict = folder / hashlib.sha256("\n".join(key).encode()).hexdigest()
    step = b"ran" if shown else b"opened"
    with contextlib.suppress(OSError):
        if verdict.read_bytes() in (step, b"ran"):
            return
    # Run the script on a file of the graph and of its inputs.
    listener.on_progress(STAGE, 0, 1, name)
    with tempfile.TemporaryDirectory(prefix="me2e-opening-") as scratch:
        if file is None or ready is not model:
            file = Path(scratch) / "model.onnx"
            graph.save(ready, file)
        for index, frame in enumerate(shown):
            Path(scratch, f"{index}.npz").write_bytes(npz_bytes(frame.arrays))
        pairs = json.dumps(recurrent_inputs(model) if shown else {})
        words = [str(file), scratch, pairs, kernels, *CPU.left_out]
        done = run_script(_SCRIPT, words)
        lines = done.stdout.splitlines()
        if answers is not None and "plain" not in lines and _runs_as_here(model):
            names = [str(value.name) for value in model.graph.outputs]
            written = [Path(scratch, f"{at}.out.npz") for at in range(len(shown))]
            arrays = [load_arrays(each) for each in written if each.is_file()]
            made = [dict(zip(names, each.values(), strict=True)) for each in arrays]
            answers[key[0]] = list(zip(shown, made, strict=False))
    # Exit codes that the script does not give itself mean a crash.
    if done.returncode not in _REFUSED:
        last = (done.stdout.split() or ["start"])[-1]
        raise GraphError(f"{name}: onnxruntime {_end(done.returncode)} at step {last}")
    if "plain" in lines and done.returncode == 0:
        why = lines[lines.index("plain") - 1]
        listener.on_warning(
            f"{name}: only onnxruntime's optimizer refuses it ({why}): it is run"
            " without optimizations, and has to be in a session of yours"
        )
    elif "open" in lines:
        with contextlib.suppress(OSError):  # a home that cannot be written to
            folder.mkdir(parents=True, exist_ok=True)
            write_bytes(verdict, step)
    listener.on_progress(STAGE, 1, 1, f"{name}: {perf_counter() - begun:.1f} s")


def _runs_as_here(model: ir.Model) -> bool:
    """Return whether sessions of ours answer what the script does, run after run.

    Not with quantizers, random numbers, or a state that only a session knows.
    """
    ports = (*model.graph.inputs, *model.graph.outputs)
    return not any(
        "uantizeLinear" in node.op_type or draws(node) for node in nodes_of(model)
    ) and all(isinstance(p.type, ir.TensorType) and p.shape is not None for p in ports)


@dataclasses.dataclass(frozen=True)
class OpenedGraph:
    """A graph that takes the frames, and opened in another process.

    Attributes:
        metadata: what adapter, map and another file state of state and plan: that of
            the model, and for sessions of the file, which lacks it.
        known: which inputs are state and which output is the plan, and from where that
            is known, in a line; empty if neither is.
    """

    model: ir.Model
    metadata: Mapping[str, str]
    known: str


def opened(
    path: Path,
    recording: CalibrationSet,
    options: GraphOptions,
    listener: Listener,
    others: Iterable[Path] = (),
) -> OpenedGraph:
    """Read a graph, and open it apart; `others` lend what its own metadata lack."""
    model = load_graph(path)
    module_map = options.module_map or map_name(path)
    own = {each: graph.load(each).metadata_props for each in others if each != path}
    known = state_and_plan(model, path, options.adapter, module_map, own)
    recording.check(model)
    provider = options.runs_on
    try_first(
        model, path.name, recording, listener=listener, file=path, provider=provider
    )
    return OpenedGraph(model, *known)


def _end(code: int) -> str:
    """Describe how a process died."""
    if code == -signal.SIGKILL:
        return "was killed (out of memory?)"
    if code < 0:
        names = {each.value: each.name for each in signal.Signals}
        return f"dies of it ({names.get(-code, f'signal {-code}')})"
    return f"dies of it (exit code {code})"
