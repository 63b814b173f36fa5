"""The first node after which an engine's own values differ from those of its graph."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice

import numpy as np
import onnx_ir as ir

from me2e_compress.fidelity.correspondence import Held, held_as
from me2e_compress.fidelity.engine_run import EngineRun
from me2e_compress.fidelity.first_difference import FirstDifference, found_in
from me2e_compress.fidelity.floor import SQNR_FLOOR_DB
from me2e_compress.fidelity.sketches import sketch
from me2e_compress.fidelity.values import Values
from me2e_compress.graph.shapes import static_shape
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider

FRAMES = 2
"""Frames that are looked at: the state of the second one is the engine's."""


def first_difference_of_engine(
    model: ir.Model,
    run: EngineRun,
    *,
    floor_db: float = SQNR_FLOOR_DB,
    provider: Provider = CPU,
) -> FirstDifference:
    """Find where what an engine computed begins to differ from its graph.

    Every dumped tensor of the graph is held against it, intermediate ones too.
    ``floor_db`` is the SQNR below which a value counts as another.
    """
    feeds = [each for each, _ in islice(run.follow(run.session, run.names), FRAMES)]
    outputs = [run.dump[at] for at in range(len(feeds))]
    shown = tuple(run.frames[at] for at in range(len(feeds)))
    a = Values(model, shown)
    a.measure_shapes(shown, provider, a.unshaped())
    a.run(shown, provider, feeds)
    held = {
        value: _held_array(a, name, outputs)
        for name, value in a.by_name.items()
        if name in outputs[0]
    }

    def arrays(wanted: Iterable[str], frame: int) -> Mapping[str, Array]:
        return {name: outputs[frame][name] for name in wanted}

    floor, lossy = floor_db, True
    found = found_in(a.model, held, arrays, feeds, floor, lossy, provider)
    return dataclasses.replace(found, unknown=len(a.by_name) - len(held))


def _held_array(a: Values, name: str, outputs: Sequence[Mapping[str, Array]]) -> Held:
    """Hold a value of the graph against what an engine gave of that name."""
    shape = static_shape(a.by_name[name])
    if shape is not None and any(each[name].shape != shape for each in outputs):
        return Held(name, math.inf)
    sized = static_shape(a.by_name[a.source[name]]) is not None
    theirs = np.stack([sketch(each[name], sized=sized) for each in outputs])
    return held_as(name, a.sketch_of(name), theirs)
