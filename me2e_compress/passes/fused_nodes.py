"""Write fused operators in standard ones, or as the plugins of a library."""

import dataclasses
from collections import Counter

import onnx_ir as ir

from me2e_compress import operators
from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.graph import rewrite
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclasses.dataclass(frozen=True)
class TranslatePlugins(Pass):
    """Write every fused operator in one dialect: the plugin library of a target.

    Given:   y = MultiScaleDeformableAttnTRT(value, sizes, points, offsets, raw)

    Result:  y = trt.plugins.MultiscaleDeformableAttnPlugin_TRT(value, sizes, starts,
             points + offsets / sizes, Softmax(raw))       with dialect=tensorrt

    Operator, domain, ``plugin_version``, ``plugin_namespace``, the order and types of
    the inputs and the layout of the output become those of the library. A plugin that
    has no domain there has none in the written file.

    Attributes:
        dialect: the library; ``me2e`` is the toolkit's own form.

    Raises:
        RecipeError: no such dialect.
    """

    name = "translate-plugins"
    exact = True

    dialect: str

    def __post_init__(self) -> None:
        """Check the dialect."""
        known = operators.dialect_names()
        if self.dialect not in known:
            there = ", ".join(known)
            raise RecipeError(
                f"{self.name}: no dialect {self.dialect!r}; there are {there}"
            )

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Translate the nodes of the graph, of its bodies and of its functions.

        Raises:
            PreconditionError: the library lacks an operator or cannot express a call.
        """
        # The library must have the operator; nodes in its dialect stay
        counts: Counter[str] = Counter()
        for fused in operators.fused_nodes(model):
            node, operator = fused.node, fused.operator
            to = operators.dialect_of(operator, self.dialect)
            if to is None:
                there = ", ".join(dialect.name for dialect in operator.all_dialects())
                raise PreconditionError(
                    f"node {node.name}: the dialect {self.dialect} has no"
                    f" {operator.name} ({node.op_type}); it is in {there}"
                )
            if to != fused.dialect:
                opset, names = fused.opset, fused.names
                operators.translate(node, to, opset=opset, by=self.name, names=names)
                counts[operator.name] += 1
        return _finished(model, counts, f"in the dialect {self.dialect}")


@dataclasses.dataclass(frozen=True)
class ExpandOperators(Pass):
    """Write every fused operator, of any dialect, in standard operators.

    Given:   y = me2e.MultiScaleDeformableAttention(value, sizes, starts, at, weights)
    Result:  y = Transpose(... ReduceSum(Mul(GridSample(value, 2 * at - 1), weights)))

    The graph's opset decides which operators are used: GridSample from opset 16 on
    where the sizes of the maps are constants, else Gather. Samplers and deformable
    convolutions need opset 16, 19 or 20: an older graph is written in that first. A
    plugin that no dialect names is left alone.
    """

    name = "expand-operators"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Expand the nodes of the graph, of its bodies and of its functions.

        Raises:
            PreconditionError: the graph cannot be written in the opset of a body.
        """
        counts: Counter[str] = Counter()
        nodes = [fused.node for fused in operators.fused_nodes(model)]
        raised = operators.raise_for_bodies(model, nodes, self.name)
        for fused in operators.fused_nodes(model):
            opset, names = fused.opset, fused.names
            operators.expand(fused.node, opset=opset, by=self.name, names=names)
            counts[fused.operator.name] += 1
        result = _finished(model, counts, "expanded")
        return dataclasses.replace(result, notes=(*raised, *result.notes))


def _finished(model: ir.Model, counts: Counter[str], done: str) -> PassResult:
    """Drop what nothing reads any more, and say what was done how often."""
    if counts:
        operators.import_domains(model)
        rewrite.sweep(model)
    listed = ", ".join(f"{count} {name}" for name, count in counts.items())
    notes = (f"{done}: {listed}",) if counts else ()
    return PassResult(model, counts.total(), notes)
