"""One pass over the frames with a gauge on every watched tensor."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.calibration.insert_probes import GAUGES, arrange, tap
from me2e_compress.calibration.probes import Gauge
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session, replay

Readings: TypeAlias = npt.NDArray[np.float32]
"""What the gauges said of one frame: float32 [tensors, width of the gauge]."""


class FrameSource(Protocol):
    """Frames that can say which they are, and be read from any place on."""

    @property
    def fingerprint(self) -> str:
        """A number that changes with the content of the whole recording."""
        ...

    @property
    def places(self) -> Sequence[int]:
        """Where in the whole recording these frames stand."""
        ...

    def __len__(self) -> int:
        """Count the frames."""
        ...

    def __getitem__(self, index: int) -> Frame:
        """Read one frame."""
        ...


def stream(
    session: Session,
    frames: FrameSource,
    width: int,
    begin: int = 0,
    state: Mapping[str, Array] | None = None,
) -> Iterator[tuple[Readings, dict[str, Array]]]:
    """Run a gauged model over frames, its own recurrent state fed forward.

    Args:
        session: of :func:`gauged`.
        frames: the recording.
        width: of the gauge.
        begin: the first frame to run.
        state: what recurrent inputs hold there, if it is not the first of a scene.

    Yields:
        For every frame what the gauges say, and the state for the next frame.
    """
    rest = (frames[index] for index in range(begin, len(frames)))
    wanted = [GAUGES, *session.recurrent.values()]
    for values in replay(session, rest, wanted, state):
        gauges = values[GAUGES].astype(np.float32).reshape(-1, width)
        yield (
            gauges,
            {name: values[answer] for name, answer in session.recurrent.items()},
        )


def gauged(
    model: ir.Model,
    tensors: Sequence[str],
    gauge: Gauge,
    *,
    threads: int,
    optimize: bool,
) -> Session:
    """Open a model with gauges, in the memory and nearly the time of the model.

    onnxruntime optimizes the gauged graph; then its nodes are put into an order in
    which every watched tensor is let go as early as without gauges.

    Raises:
        GraphError: no such tensor, or onnxruntime cannot run the graph.
    """
    tapped = tap(model, tensors, gauge)
    if not optimize:
        return Session(tapped, threads=threads, optimize=False, frugal=True)
    with tempfile.TemporaryDirectory(prefix="me2e-gauged-") as folder:
        path = Path(folder) / "optimized.onnx"
        Session(tapped, threads=1, rewritten=path)
        rewritten = ir.load(path)
        arrange(rewritten)
        arranged = path.with_name("arranged.onnx")
        ir.save(rewritten, arranged)
        return Session(arranged, threads=threads, optimize=False, frugal=True)
