"""Turn inputs that never change on one vehicle (camera matrices) into constants."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.archives import load_arrays
from me2e_compress.calibration.static_inputs import enter_static, static_inputs
from me2e_compress.errors import FramesError, PreconditionError, RecipeError
from me2e_compress.graph import open_shape
from me2e_compress.graph.nodes import Array
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclasses.dataclass(frozen=True)
class StaticGeometry(Pass):
    """Make inputs constant that are the same in every frame of one vehicle.

    Given:   lidar2img float[1,6,4,4] -> at = MatMul(pillars, lidar2img) -> ...

    Result:  at = MatMul(pillars, lidar2img), lidar2img a weight; a following
             ``fold-constants`` computes at, and all else that depends only on weights

    An exported graph computes in every frame where each pillar of the grid falls in
    each camera, and which queries a camera sees, although this changes only when a
    camera is moved. The graph then fits one vehicle: the input is gone, and frames that
    hold another value are refused. It is lossy only in this sense; for the vehicle
    itself outputs are equal up to rounding.

    Attributes:
        inputs: the inputs that become constant.
        calibration: an ``.npz`` that holds them by name, such as one frame; None takes
            them from the frames, which must all agree.
    """

    name: ClassVar[str] = "static-geometry"
    exact: ClassVar[bool] = False
    changes_interface: ClassVar[bool] = True
    inputs: tuple[str, ...] = ("lidar2img",)
    calibration: Path | None = None

    def __post_init__(self) -> None:
        """Check that inputs are given."""
        if not self.inputs:
            raise RecipeError(f"{self.name} needs inputs: inputs=[lidar2img]")

    @property
    def needs_frames(self) -> bool:
        """Whether the values are read from the frames."""
        return self.calibration is None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Register the values as weights under the names of the inputs.

        Raises:
            PreconditionError: the graph has no such input, or it is an output too.
            FramesError: a value is missing, does not fit, or differs between frames.
        """
        # Inputs that are constant already need no change
        known = static_inputs(model)
        ports = {str(value.name): value for value in model.graph.inputs}
        wanted = [name for name in self.inputs if name not in known]
        for name in wanted:
            if name not in ports:
                raise PreconditionError(
                    f"{self.name}: no input is called {name!r}; there is"
                    f" {', '.join(ports) or 'none'}"
                )
            if ports[name].is_graph_output():
                raise PreconditionError(f"{self.name}: {name} is an output too")
        if not wanted:
            return PassResult(model, 0)
        # Check every value against its input, then replace it
        arrays = self._read(wanted, context)
        for name in wanted:
            _check(ports[name], arrays[name], f"{self.name}: {name}")
            _fix(model, ports[name], arrays[name])
        enter_static(model, arrays)
        graph.infer_shapes(model)  # its dimensions may have been open
        said = ", ".join(wanted)
        return PassResult(model, len(wanted), (f"constant from now on: {said}",))

    def _read(self, names: list[str], context: Context) -> dict[str, Array]:
        if self.calibration is not None:
            arrays = load_arrays(self.calibration)
            return {name: _held(arrays, name, str(self.calibration)) for name in names}
        if context.frames is None:
            raise FramesError(
                f"{self.name} needs recorded frames (--frames) or a file"
                " (calibration=RIG.npz)"
            )
        # All frames must agree with the first
        found: dict[str, Array] = {}
        for frame in context.frames:
            for name in names:
                array = _held(frame.arrays, name, f"frame {frame.index}")
                first = found.setdefault(name, array)
                if not np.array_equal(first, array):
                    raise FramesError(
                        f"{self.name}: frame {frame.index} has another {name} than the"
                        " first: it is not constant"
                    )
        return found


def _held(arrays: Mapping[str, Array], name: str, where: str) -> Array:
    if name not in arrays:
        raise FramesError(
            f"{where}: {name} is missing; there is {', '.join(arrays) or 'none'}"
        )
    return arrays[name]


def _check(value: ir.Value, array: Array, where: str) -> None:
    kind = None if value.dtype is None else value.dtype.numpy()
    if kind is not None and array.dtype != kind:
        raise FramesError(f"{where} is {array.dtype}, expected {kind}")
    # Open dimensions fit any size
    wanted = open_shape(value)
    if wanted is not None and (
        len(wanted) != array.ndim
        or any(a not in (None, b) for a, b in zip(wanted, array.shape, strict=True))
    ):
        raise FramesError(
            f"{where} has shape {list(array.shape)}, expected {value.shape}"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise FramesError(f"{where} is not finite")


def _fix(model: ir.Model, value: ir.Value, array: Array) -> None:
    model.graph.inputs.remove(value)
    value.const_value = ir.tensor(np.ascontiguousarray(array), name=value.name)
    value.shape = ir.Shape(array.shape)
    model.graph.register_initializer(value)
