"""Mean values over a recording: constants that replace an ablated module."""

import dataclasses
from collections.abc import Sequence
from typing import cast

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.runtime.frames import Array, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay


def token_means(
    model: ir.Model,
    frames: Frames,
    values: Sequence[str],
    *,
    threads: int = 0,
    provider: Provider = CPU,
) -> dict[str, Array]:
    """Average values over a recording, element by element, in one streaming pass.

    The model runs as it is, its recurrent state fed forward and reset at the start of a
    scene. ``values`` are names in the main graph; means keep their shape and type.

    Raises:
        GraphError: no such value, or onnxruntime cannot run the graph.
        FramesError: a frame does not fit, changes the shape of a value, or makes it
            NaN or infinite.
    """
    if not values:
        return {}
    # A copy of the graph has the values as further outputs.
    copy = model.clone()
    computed = {value.name: value for node in copy.graph for value in node.outputs}
    if missing := [name for name in values if name not in computed]:
        raise GraphError(f"the graph has no value {missing[0]}")
    outputs = {value.name for value in copy.graph.outputs}
    more = (computed[name] for name in dict.fromkeys(values) if name not in outputs)
    copy.graph.outputs.extend(more)
    session = Session(copy, threads=threads, provider=provider)
    # One pass: the averages are updated frame by frame.
    averages = {name: _Average(name) for name in values}
    for index, answers in enumerate(replay(session, frames, list(values))):
        for name, average in averages.items():
            average.take(index, answers[name])
    return {name: average.result() for name, average in averages.items()}


@dataclasses.dataclass
class _Average:
    """Running average of one value.

    Floats and booleans are summed in float64; integers, few indices, are stored.
    """

    name: str
    count: int = 0
    total: npt.NDArray[np.float64] | None = None
    values: list[Array] = dataclasses.field(default_factory=list)
    like: Array | None = None

    def take(self, index: int, value: Array) -> None:
        if self.like is not None and value.shape != self.like.shape:
            raise FramesError(
                f"frame {index} makes {self.name} {list(value.shape)}, it was"
                f" {list(self.like.shape)}: a mean needs one shape"
            )
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            kind = "NaN" if np.isnan(value).any() else "infinite"
            raise FramesError(f"frame {index} makes {self.name} {kind}: it has no mean")
        # Integers need all values for their mode.
        self.like, self.count = value, self.count + 1
        if value.dtype.kind in "iu":
            self.values.append(value)
        else:
            wide = value.astype(np.float64)
            self.total = wide if self.total is None else self.total + wide

    def result(self) -> Array:
        if self.like is None:
            raise FramesError(f"no frames: {self.name} has no mean")
        # Integers give the most frequent value (the smallest in a tie)
        if self.total is None:
            from scipy import stats  # takes a second to import

            # the smallest of the most frequent values
            stack = cast("npt.NDArray[np.int64]", np.stack(self.values))  # any integers
            return np.asarray(stats.mode(stack).mode, self.like.dtype)
        # Floats give their mean, booleans the majority (True in a tie)
        mean = np.asarray(self.total / self.count)
        if self.like.dtype == np.bool_:
            return np.asarray(mean >= 0.5)
        return mean.astype(self.like.dtype)
