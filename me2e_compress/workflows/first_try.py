"""Open a graph that is new to this machine in a process of its own first."""

from functools import partial
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph import JoinedStack, is_stack
from me2e_compress.runtime import first_opening
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
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
    """Open a graph in another process, if it is new here, and run its first frame.

    `file` holds the same graph as `model`, or is the stack that it was joined from;
    without `frames` the graph is only opened. The listener is told how long this took,
    since no other time includes it. Providers other than the plain CPU are not tried:
    what they do to a graph does not follow from it.

    Raises:
        GraphError: onnxruntime crashes on the graph.
    """
    if provider != CPU:
        return
    file = None if file is None or is_stack(file) else file
    first = None if frames is None else next(iter(frames), None)
    feeds = None if first is None else first.arrays
    begins = partial(listener.on_progress, STAGE, 0, 1, name)
    seconds = first_opening.try_apart(
        model, name, file=file, feeds=feeds, on_begin=begins
    )
    if seconds:
        listener.on_progress(STAGE, 1, 1, f"{name}: {seconds:.1f} s")


def try_model(
    model: ir.Model,
    file: Path,
    frames: Frames,
    listener: Listener,
    provider: Provider = CPU,
) -> None:
    """Open the graph of a file in another process, and run it; see :func:`try_first`.

    Of a stack, what runs at first frames alone is opened too.
    """
    if is_stack(file):
        try_file(file, listener, provider)
        return
    try_first(model, file.name, listener, file=file, frames=frames, provider=provider)


def try_file(file: Path, listener: Listener, provider: Provider = CPU) -> None:
    """Open the graph of a file, or both of a stack, in another process.

    The graphs are not run.
    """
    if provider != CPU:
        return
    try:
        if is_stack(file):
            stack = JoinedStack.load(file)
            for each in filter(None, (stack.model, stack.first)):
                try_first(each, file.name, listener)
            return
        model = graph.load(file)
    except GraphError:
        return  # who opens it says what is wrong
    try_first(model, file.name, listener, file=file)
