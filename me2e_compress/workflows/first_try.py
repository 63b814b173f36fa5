"""A graph that was never opened here is opened in a process of its own first."""

from functools import partial
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.runtime import first_opening
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.stack.split_stack import SplitStack, is_stack
from me2e_compress.workflows.listener import Listener

STAGE = "first opening"


def try_first(
    model: ir.Model,
    name: str,
    listener: Listener,
    *,
    file: Path | None = None,
    frames: Frames | None = None,
    provider: Provider = CPU,
) -> None:
    """Open a graph apart, if this machine has not seen it; run its first frame there.

    Not for another provider than the CPU with its own operators: what they do to a
    graph is not known from there.

    Args:
        model: the graph.
        name: what messages call it.
        listener: is told how long it took: no other time counts it.
        file: that holds this very graph.
        frames: a recording that fits it; without one, the graph is not run.
        provider: what runs it.

    Raises:
        GraphError: onnxruntime dies of the graph.
    """
    if provider != CPU:
        return
    first = None if frames is None else next(iter(frames), None)
    feeds = None if first is None else first.arrays
    begins = partial(listener.on_progress, STAGE, 0, 1, name)
    seconds = first_opening.try_apart(
        model, name, file=file, feeds=feeds, on_begin=begins
    )
    if seconds:
        listener.on_progress(STAGE, 1, 1, f"{name}: {seconds:.1f} s")


def load_interface(file: Path) -> ir.Model:
    """Read an ONNX file; of a stack of several its inputs and outputs, without nodes.

    Raises:
        GraphError: not a graph, or files that do not fit each other.
    """
    return SplitStack.load(file).interface() if is_stack(file) else graph.load(file)


def try_model(
    model: ir.Model,
    file: Path,
    frames: Frames,
    listener: Listener,
    provider: Provider = CPU,
) -> None:
    """Open a file apart, or each of a stack, if this machine has not seen it.

    Args:
        model: of :func:`load_interface`.
        file: the ONNX file, or the TOML of a stack.
        frames: a recording that fits it; a graph is run on the first.
        listener: is told how long it took.
        provider: what runs it.

    Raises:
        GraphError: onnxruntime dies of it.
    """
    if is_stack(file):
        try_file(file, listener, provider)
        return
    try_first(model, file.name, listener, file=file, frames=frames, provider=provider)


def try_file(file: Path, listener: Listener, provider: Provider = CPU) -> None:
    """Open the graph of a file apart, if this machine has not seen it.

    Args:
        file: that holds the graph, or the TOML of a stack: then each of its files.
        listener: is told how long it took.
        provider: what runs it; another than the CPU is not tried.

    Raises:
        GraphError: onnxruntime dies of the graph, or the files of a stack do not fit.
    """
    if provider != CPU:
        return
    if is_stack(file):
        for each in SplitStack.load(file).files.values():
            try_file(each.path, listener, provider)
        return
    try:
        model = graph.load(file)
    except GraphError:
        return  # who opens it says what is wrong
    try_first(model, file.name, listener, file=file)
