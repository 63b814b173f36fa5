"""What was written beside its source: whether it is larger, or no faster here."""

import time
from pathlib import Path

import onnx

from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.graph import file_bytes
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session, replay

ROUNDS = 5
"""Runs of each file, the least of which counts."""
ENOUGH_S = 3.0
"""So long is measured at most, but for the first round."""


def size_note(source: Path, output: Path) -> str:
    """Return by how much a file is larger than its source, and why; else empty."""
    more = file_bytes(output) - file_bytes(source)
    if more <= 0:
        return ""
    model = onnx.load(output, load_external_data=False)
    notes = [entry for node in model.graph.node for entry in node.metadata_props]
    known = sum(each.ByteSize() for each in (*notes, *model.metadata_props))
    shapes = sum(each.ByteSize() for each in model.graph.value_info)
    return (
        f"{output.name} is {more:,} bytes larger than {source.name}: origins and plan"
        f" take {known:,}, shapes {shapes:,}, the rest are nodes and weights"
    )


def speed_note(source: Path, output: Path, frames: Frames, provider: Provider) -> str:
    """Return how much longer than its source a file takes here; empty if not longer.

    CPU time of one frame on one thread, in turn, as anybody opens the files. Empty,
    too, where one of them does not run.
    """
    frame = next(iter(frames))
    least, begun = dict[Path, float](), time.perf_counter()
    try:
        sessions = {
            path: Session(path, threads=1, stock=True, provider=provider)
            for path in (source, output)
        }
        for _ in range(1 + ROUNDS):
            for path, session in sessions.items():
                start = time.process_time()
                next(replay(session, [frame]))
                took = time.process_time() - start
                least[path] = min(took, least.get(path, took))
            if time.perf_counter() - begun > ENOUGH_S:
                break
    except (FramesError, GraphError):
        return ""
    ratio = least[output] / least[source]
    if ratio < 1:
        return ""
    return (
        f"{output.name} takes {ratio:.2f} times as long as {source.name} here (CPU time"
        " of one frame, one thread)"
    )
