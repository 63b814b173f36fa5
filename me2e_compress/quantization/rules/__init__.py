"""Why a node stays in float: small rules, asked in order, the first answer counts.

To add a rule or a set of rules: write its class, then add it to its table in ``base``.
"""

import abc
import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import ClassVar, TypeAlias

import onnx_ir as ir

from me2e_compress.base.errors import RecipeError
from me2e_compress.base.registry import Registry
from me2e_compress.calibration.observers import DEFAULT_METHOD
from me2e_compress.graph import WEIGHTED, static_shape
from me2e_compress.graph.nodes import constant_values
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.quantization.costs import CostsOf
from me2e_compress.quantization.find_attention import (
    Attention,
    find_attention,
    find_attention_weights,
)
from me2e_compress.quantization.geometry import (
    MATRICES,
    find_coordinates,
    find_geometry,
)

__all__ = ["DEFAULT_RULES", "RULES", "RULE_SETS", "Rule", "RuleFacts", "RuleSet"]


# Find the small encoders of the ego car's own status.


# In a status: speed, acceleration, steering, pose, command; ``can_bus`` has 18.
MOST_NUMBERS = 64

# Elements of the largest input, where a graph has sensors beside a status.
LEAST_SENSED = 1024

LARGEST = 4096
"""Elements of what still is a status, encoded: more is a map that it was added to."""


def find_ego_layers(
    model: ir.Model, constants: Collection[ir.Value]
) -> dict[ir.Node, str]:
    """Map every layer that sees nothing but the ego car's status to its input.

    A status is an input of at most 64 numbers beside a sensor's, neither recurrent nor
    made of matrices: ``can_bus`` [18], a speed, a command. Its encoder are the layers
    that depend on statuses alone, until they meet other data or grow to more than 4,096
    elements.

    One sweep over the graph, which is in topological order. ``constants`` are values
    that no input changes.
    """
    sources = dict(_statuses(model))
    layers: dict[ir.Node, str] = {}
    for node in model.graph if sources else ():
        reads = [value for value in node.inputs if value is not None]
        changing = [value for value in reads if value not in constants]
        if not changing or any(value not in sources for value in changing):
            continue
        # its results are a status too, while they are small
        name = sources[changing[0]]
        if node.op_type in WEIGHTED:
            layers[node] = name
        sizes = [_elements(value) for value in node.outputs]
        if all(size is not None and size <= LARGEST for size in sizes):
            sources.update(dict.fromkeys(node.outputs, name))
    return layers


def _statuses(model: ir.Model) -> Iterator[tuple[ir.Value, str]]:
    inputs = [
        value
        for value in model.graph.inputs
        if str(value.name) not in model.graph.initializers
    ]
    # a graph without any sensor has no status beside it
    sizes = {value: _elements(value) for value in inputs}
    known = [size for size in sizes.values() if size is not None]
    if None not in sizes.values() and max(known, default=0) < LEAST_SENSED:
        return
    # small inputs that are neither states nor matrices
    recurrent = recurrent_inputs(model)
    for value, size in sizes.items():
        shape = static_shape(value) or ()
        if size is None or size > MOST_NUMBERS or shape[-2:] in MATRICES:
            continue
        if str(value.name) not in recurrent:
            yield value, str(value.name)


def _elements(value: ir.Value) -> int | None:
    shape = static_shape(value)
    return None if shape is None else math.prod(shape)


Objection: TypeAlias = Callable[[ir.Node], str | None]
"""Says why a target cannot read int8 in a fused operator; None where it can."""


@dataclasses.dataclass(frozen=True, eq=False)
class RuleFacts:
    """Facts about a graph for rules; each is computed when first asked for.

    Attributes:
        model: the graph, shapes inferred, in topological order.
        modules: which are to be int8.
        costs: estimates what int8 saves and costs on the target; None if no target is
            known, or it says nothing of costs.
        fused: why fused operators read no int8 on the target; None if no target is
            known.
    """

    model: ir.Model
    modules: Collection[str]
    costs: CostsOf | None = None
    fused: Objection | None = None

    @functools.cached_property
    def constants(self) -> Collection[ir.Value]:
        """The values that no input changes: weights, and what follows from them."""
        return constant_values(self.model)

    @functools.cached_property
    def weight_elements(self) -> int:
        """How many numbers the graph's weights hold."""
        shapes = map(static_shape, self.model.graph.initializers.values())
        return sum(math.prod(shape) for shape in shapes if shape is not None)

    @functools.cached_property
    def attention(self) -> Mapping[ir.Node, Attention]:
        """The nodes that take part in an attention, each with that attention."""
        return find_attention(self.model, self.constants)

    @functools.cached_property
    def attention_weights(self) -> Mapping[ir.Node, str]:
        """The products that read attention weights or give them, with the reason."""
        return find_attention_weights(self.model, self.attention)

    @functools.cached_property
    def geometry(self) -> Mapping[ir.Node, str]:
        """The products that geometry goes through, each with the reason."""
        return find_geometry(self.model, self.constants)

    @functools.cached_property
    def ego_layers(self) -> Mapping[ir.Node, str]:
        """The layers that see only the ego car's status, each with that input."""
        return find_ego_layers(self.model, self.constants)

    @functools.cached_property
    def coordinates(self) -> Mapping[ir.Node, str]:
        """The layers that positions come from, each with the reason."""
        return find_coordinates(self.model, self.constants)


@dataclasses.dataclass(frozen=True)
class Rule(abc.ABC):
    """Keeps some nodes in float: derive a frozen dataclass, its fields are options.

    Class attributes:
        name: the rule's name in plans, reports and recipes.
        firm: True where the node cannot be int8 at all, so that no override lifts it.
    """

    name: ClassVar[str]
    firm: ClassVar[bool] = False

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Return why this node stays in float; None if it need not."""
        return None

    def objections(
        self, int8: Collection[ir.Node], facts: RuleFacts
    ) -> Mapping[ir.Node, str]:
        """Return why some nodes stay in float, now that all others are decided.

        ``int8`` are the nodes that no rule objects to, in graph order.
        """
        return {}

    def __str__(self) -> str:
        """Return its text, as rule sets name it."""
        return RULES.text(self)


_HERE = "me2e_compress.quantization.rules"

RULES: Registry[Rule] = Registry(
    "rule",
    "me2e_compress.rules",
    RecipeError,
    {
        "operator": f"{_HERE}.rule_sets:WeightedOperator",
        "fused-operator": f"{_HERE}.rule_sets:FusedOperator",
        "module": f"{_HERE}.rule_sets:ModuleScope",
        "weight": f"{_HERE}.rule_sets:WeightOperand",
        "attention-length": f"{_HERE}.rule_sets:AttentionLength",
        "gemv": f"{_HERE}.rule_sets:MatrixVector",
        "geometry": f"{_HERE}.rule_sets:Geometry",
        "coordinates": f"{_HERE}.rule_sets:Coordinates",
        "ego-input": f"{_HERE}.rule_sets:EgoInput",
        "attention-weights": f"{_HERE}.rule_sets:AttentionWeights",
        "small-product": f"{_HERE}.rule_sets:SmallProduct",
        "narrow-convolution": f"{_HERE}.rule_sets:NarrowConvolution",
        "size": f"{_HERE}.rule_sets:FileSize",
        "cost": f"{_HERE}.rule_sets:CostGate",
    },
)


@dataclasses.dataclass(frozen=True)
class RuleSet(abc.ABC):
    """Rules that are asked together: derive a frozen dataclass, its fields are options.

    Class attributes:
        name: the set's name in plans and recipes.
        share_concat: whether the inputs of a Concat are put on one scale with its
            result, so that it moves int8 without requantizing.
        method: how ranges are read from the frames where a recipe names no method.

    Attributes:
        without: names of rules that are switched off.
        extra: more rules, asked last: ``my-rule``, ``my-rule{limit=3}``, or the rule
            itself, which need not be registered.
        balance: whether weights are rounded so that the errors of a kernel and of a
            channel cancel, instead of each to the nearest.
    """

    name: ClassVar[str]
    share_concat: ClassVar[bool] = False
    method: ClassVar[str] = DEFAULT_METHOD
    without: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)
    extra: tuple[str | Rule, ...] = dataclasses.field(default=(), kw_only=True)
    balance: bool = dataclasses.field(default=False, kw_only=True)

    def __str__(self) -> str:
        """Return its text, as recipes name it."""
        return RULE_SETS.text(self)

    @abc.abstractmethod
    def own_rules(self) -> tuple[Rule, ...]:
        """Return its rules in the order in which they are asked."""

    def rules(self) -> tuple[Rule, ...]:
        """Return the rules that are asked, in order.

        Raises:
            RecipeError: no such extra rule, or one that cannot be switched off.
        """
        more = (RULES.parse(e) if isinstance(e, str) else e for e in self.extra)
        rules = (*self.own_rules(), *more)
        # firm rules cannot be switched off
        loose = [rule.name for rule in rules if not rule.firm]
        for name in self.without:
            if name not in loose:
                raise RecipeError(
                    f"rule {name} cannot be switched off; of {self.name} can"
                    f" {', '.join(loose)}"
                )
        return tuple(rule for rule in rules if rule.name not in self.without)


RULE_SETS: Registry[RuleSet] = Registry(
    "rule set",
    "me2e_compress.rule_sets",
    RecipeError,
    {"safe": f"{_HERE}.rule_sets:SafeRules", "paper": f"{_HERE}.rule_sets:PaperRules"},
)

DEFAULT_RULES = "safe"
"""The rule set of every plan for which none is named, whatever its target."""
