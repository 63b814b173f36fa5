"""The first node after which an engine's own values differ from those of its graph."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import EvaluationError
from me2e_compress.fidelity.correspondence import Held, held_as
from me2e_compress.fidelity.first_difference import FirstDifference, found_in
from me2e_compress.fidelity.floor import SQNR_FLOOR_DB
from me2e_compress.fidelity.sketches import sketch
from me2e_compress.fidelity.values import Fed, Values, first_state
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.graph.shapes import static_shape
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, Provider


def first_difference_of_outputs(
    model: ir.Model,
    frames: Iterable[Frame],
    outputs: Sequence[Mapping[str, Array]],
    *,
    floor_db: float = SQNR_FLOOR_DB,
    provider: Provider = CPU,
) -> FirstDifference:
    """Find where what an engine computed begins to differ from its graph.

    Args:
        model: the graph.
        frames: what the engine was fed.
        outputs: its outputs and intermediate ones by name, frame by frame. State that
            is among them is fed to the graph too.
        floor_db: the SQNR below which a value counts as another.
        provider: execution provider of the graph.

    Raises:
        EvaluationError: there is no frame or none of the outputs is a value of the
            graph; or the numbers of frames differ.
        FramesError: a frame does not fit.
        GraphError: onnxruntime cannot run the graph.
    """
    shown = tuple(frames)
    if not shown or len(shown) != len(outputs):
        raise EvaluationError(f"{len(outputs)} outputs for {len(shown)} frames")
    a = Values(model, shown)
    a.measure_shapes(shown, provider, a.unshaped())
    names = [name for name in a.by_name if all(name in each for each in outputs)]
    if not names:
        given = ", ".join(list(outputs[0])[:5]) or "none"
        raise EvaluationError(f"no output is a value of the graph: {given}")
    fed = a.run(shown, provider, _as_engine_was_fed(a, shown, outputs))
    held = {a.by_name[name]: _held_array(a, name, outputs) for name in names}

    def arrays(wanted: Iterable[str], frame: int) -> Mapping[str, Array]:
        return {name: outputs[frame][name] for name in wanted}

    floor, lossy = floor_db, True
    found = found_in(a.model, held, arrays, fed, floor, lossy, provider)
    return dataclasses.replace(found, unknown=len(a.by_name) - len(held))


def _as_engine_was_fed(
    a: Values, frames: Sequence[Frame], outputs: Sequence[Mapping[str, Array]]
) -> Fed | None:
    """Return what the engine was fed; None where its state is not among its outputs."""
    pairs = recurrent_inputs(a.model)
    if not all(answer in outputs[0] for answer in pairs.values()):
        return None
    feeds = []
    for at, frame in enumerate(frames):
        if at and not frame.starts_scene:
            memory = {name: outputs[at - 1][out] for name, out in pairs.items()}
        else:
            memory = first_state(a.model, frame)
        feeds.append({**frame.arrays, **memory})
    return feeds


def _held_array(a: Values, name: str, outputs: Sequence[Mapping[str, Array]]) -> Held:
    """Hold a value of the graph against what an engine gave of that name."""
    shape = static_shape(a.by_name[name])
    if shape is not None and any(each[name].shape != shape for each in outputs):
        return Held(name, math.inf)
    sized = static_shape(a.by_name[a.source[name]]) is not None
    theirs = np.stack([sketch(each[name], sized=sized) for each in outputs])
    return held_as(name, a.sketch_of(name), theirs)
