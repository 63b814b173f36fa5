"""What becomes of one node, and of all of them."""

import dataclasses
from collections import Counter

from me2e_compress.quantization.rules import WEIGHTED
from me2e_compress.quantization.scheme import QuantScheme

INT8 = "int8"
FLOAT = "float"
RESIDUAL = "residual"
Shape = tuple[int, ...] | None


@dataclasses.dataclass(frozen=True)
class Decision:
    """What becomes of one node.

    Attributes:
        node: its name, which need not be unique.
        output: name of its first output, which is.
        op: its operator.
        module: its ME2E module; empty if unknown.
        dtype: ``int8`` or ``float``.
        rule: id of the rule that decided; for int8 ``layer``, ``attention`` or
            ``residual``; ``override`` where the user did.
        reason: the same in words.
        shapes: of the first two inputs and the first output; None where open.
        activations: which inputs get an activation scale. Of an Add it is one, the
            residual branch: the other comes out of a convolution that it is fused with.
        weight: which input is stored as int8; None where none is.
        axis: of the weight's per-channel scales; None for one scale in all, as
            a batch of matrices has.
        borderline: what was close about it; empty if nothing was.
    """

    node: str
    output: str
    op: str
    module: str
    dtype: str
    rule: str
    reason: str
    shapes: tuple[Shape, ...]
    activations: tuple[int, ...] = ()
    weight: int | None = None
    axis: int | None = None
    borderline: str = ""


@dataclasses.dataclass(frozen=True)
class ScaleGroup:
    """Tensors, or readers of one, that are quantized together.

    Attributes:
        kind: ``shared-input``: several nodes read one tensor, through one pair;
            ``concat``: what a Concat joins and what it gives are on one scale.
        name: of the tensor, or of the Concat.
        tensors: the activations on one scale.
        nodes: names of the nodes that read them in int8.
    """

    kind: str
    name: str
    tensors: tuple[str, ...]
    nodes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class KeptFloat:
    """A node that a plan makes int8, and one target does not.

    Attributes:
        node: its name.
        output: name of its first output.
        reason: what the target lacks.
    """

    node: str
    output: str
    reason: str


@dataclasses.dataclass(frozen=True)
class QuantPlan:
    """Decisions for every node of a graph, in graph order; the same for all targets.

    Attributes:
        scheme: what was asked for.
        decisions: one a node.
        rules: name of the rule set that was asked.
        groups: what was decided together.
        kept_float: which of its int8 nodes stay float on the target for which it was
            carried out; none where it was not.
    """

    scheme: QuantScheme
    decisions: tuple[Decision, ...]
    rules: str = "paper"
    groups: tuple[ScaleGroup, ...] = ()
    kept_float: tuple[KeptFloat, ...] = ()

    @property
    def chosen(self) -> tuple[Decision, ...]:
        """The nodes that read int8: layers, attention products, residual Adds."""
        return tuple(each for each in self.decisions if each.dtype == INT8)

    @property
    def placed(self) -> tuple[Decision, ...]:
        """Those of them that are int8 in the graph for the target."""
        left = {each.output for each in self.kept_float}
        return tuple(each for each in self.chosen if each.output not in left)

    @property
    def borderline(self) -> tuple[Decision, ...]:
        """The nodes whose decision was close."""
        return tuple(each for each in self.decisions if each.borderline)

    def counts(self) -> dict[str, int]:
        """Count the decisions by rule, over the nodes that could be int8 at all."""
        rules = Counter(
            each.rule
            for each in self.decisions
            if each.op in WEIGHTED or each.dtype == INT8
        )
        return dict(sorted(rules.items()))
