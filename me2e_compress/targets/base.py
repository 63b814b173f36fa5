"""What every target is."""

import abc
import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.quantization.plan import KeptFloat, QuantPlan
from me2e_compress.targets.finding import LintRule


@dataclasses.dataclass(frozen=True)
class Target(abc.ABC):
    """A program that runs graphs: how int8 is written for it, and what it refuses.

    Derive a frozen dataclass; its fields are its options.

    Class attributes:
        name: what recipes and the command line call it.
    """

    name: ClassVar[str]

    @abc.abstractmethod
    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """Name the activations whose ranges :meth:`place` needs."""

    @abc.abstractmethod
    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Return a copy of a float graph in which a plan's nodes are int8."""

    def kept_float(self, plan: QuantPlan, model: ir.Model) -> tuple[KeptFloat, ...]:
        """List the plan's nodes that stay float in that copy, and why."""
        return ()

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Return the rules that a graph for it is held against."""
        return ()
