"""Turn inputs that have one value on all frames (camera matrices) into constants."""

import dataclasses
import json
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import FramesError, PreconditionError
from me2e_compress.calibration import dataset
from me2e_compress.graph.nodes import nodes_of, producer_of
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.graph.shapes import static_shape
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.quantization.geometry import MATRICES, MOST_MATRICES
from me2e_compress.runtime.frames import Array

# Most numbers of an input that a branch hangs on: flags, a sample rate.
FLAGS = 16


@dataclasses.dataclass(frozen=True)
class FreezeInputs(Pass):
    """Make inputs constant that have one value on all frames.

    Given:   lidar2img float[1,6,4,4] -> at = MatMul(pillars, lidar2img) -> ...

    Result:  at = MatMul(pillars, lidar2img) of weights, which ``fold-constants`` folds

    The graph then fits one vehicle: the input is gone, and frames that hold another
    value are refused. For that vehicle outputs are equal up to rounding.

    Attributes:
        inputs: the inputs that become constant.
    """

    name = "freeze-inputs"
    exact = False
    changes_interface = True
    inputs: tuple[str, ...] = ("lidar2img",)

    @property
    def needs_frames(self) -> bool:
        """Whether the values are read from the frames: always."""
        return True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Register the values as weights under the names of the inputs."""
        known = dataset.frozen_inputs(model)
        names = [name for name in self.inputs if name not in known]
        if not names:
            return PassResult(model, 0)
        ports = {str(value.name): value for value in model.graph.inputs}
        for name in names:
            if name not in ports or ports[name].is_graph_output():
                line = f"no input is called {name!r}, or it is an output too"
                there = ", ".join(ports) or "none"
                raise PreconditionError(f"{self.name}: {line}; there is {there}")
        # All frames must hold the value of the first
        arrays: dict[str, Array] = {}
        for frame in context.frames or ():
            where = f"{self.name}: frame {frame.index}"
            for name in names:
                if name not in frame.arrays:
                    raise FramesError(f"{where}: {name} is missing")
                array = frame.arrays[name]
                if not np.array_equal(arrays.setdefault(name, array), array):
                    raise FramesError(f"{where} has another {name} than the first")
        if not arrays:
            raise FramesError(f"{self.name} needs recorded frames (--frames)")
        # The inputs become initializers of the same names
        for name, array in arrays.items():
            value = ports[name]
            dataset.check_array(array, value, f"{self.name}: {name}")
            model.graph.inputs.remove(value)
            value.const_value = ir.tensor(np.ascontiguousarray(array), name=name)
            value.shape = ir.Shape(array.shape)
            model.graph.register_initializer(value)
            known[name] = dataset.digest_of(array)
        model.metadata_props[dataset.FROZEN_INPUTS] = json.dumps(known, sort_keys=True)
        listed = ", ".join(names)
        return PassResult(model, len(names), (f"constant from now on: {listed}",))


def advice(model: ir.Model) -> str:
    """Return a sentence that names inputs that may become constants, or ""."""
    names = ",".join(deciding_inputs(model))
    return names and (
        f"branches or projections hang on {names}: where all frames have one value,"
        " compress first with --passes"
        f" import-normalize,freeze-inputs{{inputs=[{names}]}},fold-constants"
    )


def deciding_inputs(model: ir.Model) -> tuple[str, ...]:
    """Name the inputs that alone decide a branch, or are matrices of a projection."""
    names, states = dict[str, None](), recurrent_inputs(model)
    for node in nodes_of(model):
        if node.op_type not in ("If", "MatMul"):
            continue
        roots = [root for value in node.inputs for root in _roots(model, value)]
        largest = FLAGS
        if node.op_type == "MatMul":
            roots = [v for v in roots if (static_shape(v) or ())[-2:] in MATRICES]
            largest = 16 * MOST_MATRICES
        # Larger inputs are sensors, and states are no constants
        sizes = [static_shape(root) for root in roots]
        if all(size is not None and math.prod(size) <= largest for size in sizes):
            names |= dict.fromkeys(str(root.name) for root in roots)
    return tuple(name for name in names if name not in states)


def _roots(model: ir.Model, value: ir.Value | None) -> list[ir.Value]:
    """Return the inputs whose numbers, not only their sizes, a value depends on."""
    visited, pending = set[ir.Value](), [value]
    while pending:
        value = pending.pop()
        if value is None or value in visited:
            continue
        visited.add(value)
        made = producer_of(value)
        if made is not None and made.op_type not in ("Shape", "Size"):
            pending += made.inputs
    return [port for port in model.graph.inputs if port in visited]
