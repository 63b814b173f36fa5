"""What every pass is."""

import dataclasses
from typing import ClassVar, Protocol, runtime_checkable

import onnx_ir as ir

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.modules import ModuleMap


@dataclasses.dataclass(frozen=True)
class Context:
    """What a pass may ask for besides the graph.

    Attributes:
        modules: which part of the graph is which.
        frames: recorded inputs, in scenes; None where the user gave none.
        seed: for everything random.
    """

    modules: ModuleMap
    frames: CalibrationSet | None = None
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class PassResult:
    """The graph after a pass, and what to say about it.

    Attributes:
        model: the graph, the same object where the pass works in place.
        changes: how many places changed; 0 exactly if the graph is as it was.
        removed_outputs: names of the graph outputs that went, where the options asked
            for that; every other output and every input must be as it was.
        notes: sentences for the report: what was left alone and why.
    """

    model: ir.Model
    changes: int
    notes: tuple[str, ...] = ()
    removed_outputs: tuple[str, ...] = ()


@runtime_checkable
class Pass(Protocol):
    """A named rewrite: a frozen dataclass whose fields are its options.

    Class attributes:
        name: what recipes and the command line call it.
        exact: True promises the same outputs, and the manager checks it by running
            the graph before and after; False is judged by fidelity and on the road.
        changes_interface: True if the pass may change inputs and outputs at will.
    """

    name: ClassVar[str]
    exact: ClassVar[bool]
    changes_interface: ClassVar[bool]

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite the model, in place where that is cheaper."""
        ...
