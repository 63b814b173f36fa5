"""One streaming pass over the frames: ranges of many tensors, memory of inference."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import METHODS
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.taps import GAUGES, tap
from me2e_compress.errors import FramesError, RecipeError
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.session import Session, replay


class Recording(Frames, Protocol):
    """Frames that can say which they are."""

    @property
    def fingerprint(self) -> str:
        """A number that changes with the content."""
        ...


@dataclasses.dataclass(frozen=True)
class Calibrator:
    """Measures ranges.

    Attributes:
        method: ``max-min``.
        threads: within an operator; 0 for every core.
        optimize: False runs the nodes as they stand: the ranges are then those of
            tools that switch onnxruntime's optimizations off, to the bit.
    """

    method: str = "max-min"
    threads: int = 0
    optimize: bool = True

    def run(
        self,
        model: ir.Model,
        tensors: Sequence[str],
        frames: Recording,
        progress: Callable[[int, int], None] | None = None,
    ) -> Ranges:
        """Run the model once over the frames, its own recurrent state fed forward.

        Args:
            model: the float graph.
            tensors: which to measure.
            frames: the recording.
            progress: called as ``progress(frames done, frames)``.

        Raises:
            FramesError: a frame does not fit, or makes a tensor NaN or infinite; the
                message names the tensor and the frame.
            GraphError: onnxruntime cannot run the graph.
            RecipeError: no such method.
        """
        if self.method not in METHODS:
            raise RecipeError(
                f"no calibration method {self.method}; there is {', '.join(METHODS)}"
            )
        observer = METHODS[self.method]()
        if tensors:
            session = Session(
                tap(model, tensors),
                threads=self.threads,
                optimize=self.optimize,
                frugal=True,
            )
            for done, (low, high) in enumerate(_extremes(session, tensors, frames), 1):
                observer.update(low, high)
                if progress:
                    progress(done, len(frames))
        lows, highs = observer.result()
        ends = zip(lows.tolist(), highs.tolist(), strict=True)
        return Ranges(
            dict(zip(tensors, ends, strict=True)),
            self.method,
            len(frames),
            graph.digest(model),
            frames.fingerprint,
        )


def _extremes(
    session: Session, tensors: Sequence[str], frames: Iterable[Frame]
) -> "Iterable[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]":
    for index, values in enumerate(replay(session, frames, [GAUGES])):
        gauges = values[GAUGES].astype(np.float32).reshape(-1, 3)
        bad = np.isnan(gauges).any(1) | np.isinf(gauges[:, :2]).any(1)
        if bad.any():
            names = [tensors[at] for at in np.flatnonzero(bad).tolist()]
            first = gauges[bad][0]
            kind = "NaN" if np.isnan(first).any() else "infinite"
            raise FramesError(
                f"frame {index} makes tensor {names[0]} {kind}, and {len(names) - 1}"
                f" more of {len(tensors)}: no range can be read from it"
            )
        yield gauges[:, 0], gauges[:, 1]
