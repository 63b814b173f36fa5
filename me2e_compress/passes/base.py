"""The base class of passes, their context and their result."""

import abc
import dataclasses
from pathlib import Path
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.runtime.providers import CPU, Provider


@dataclasses.dataclass(frozen=True)
class Context:
    """What a pass may use besides the graph.

    ``frames`` are recorded inputs in scenes, None where the user gave none.
    ``measured`` caches ranges by pass name, so that a pass that runs again need not
    measure again.
    """

    modules: ModuleMap
    frames: CalibrationSet | None = None
    seed: int = 0
    provider: Provider = CPU
    measured: dict[str, Ranges] = dataclasses.field(
        default_factory=dict, compare=False, repr=False
    )


@dataclasses.dataclass(frozen=True)
class PassResult:
    """The graph after a pass, and what to report about it.

    Attributes:
        model: the same object where the pass works in place.
        changes: number of changes; 0 exactly if the graph is unchanged.
        removed_outputs: graph outputs removed at the user's request; every other output
            and every input must be unchanged.
        notes: sentences for the report: what was left alone and why.
    """

    model: ir.Model
    changes: int
    notes: tuple[str, ...] = ()
    removed_outputs: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Pass(abc.ABC):
    """A named rewrite of a graph; subclasses are frozen dataclasses of options.

    Class attributes:
        name: its name in recipes and on the command line.
        exact: True promises equal outputs, and the manager checks it by running the
            graph before and after; False is judged by fidelity and driving scores.
        changes_interface: True if the pass may change inputs and outputs.
    """

    name: ClassVar[str]
    exact: ClassVar[bool]
    changes_interface: ClassVar[bool] = False

    @abc.abstractmethod
    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite the model, in place where that is cheaper."""

    @property
    def needs_frames(self) -> bool:
        """Whether the pass, with these options, measures on recorded frames."""
        return False

    def files(self) -> tuple[Path, ...]:
        """Return the files that its options name."""
        values = (getattr(self, name) for name in self.option_names())
        return tuple(value for value in values if isinstance(value, Path))

    @classmethod
    def option_names(cls) -> tuple[str, ...]:
        """Return the names of the options, in order."""
        return tuple(field.name for field in dataclasses.fields(cls))
