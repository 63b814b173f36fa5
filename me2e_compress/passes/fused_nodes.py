"""Write fused operators in standard ones, or as the plugins of a library."""

import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import ClassVar

import onnx_ir as ir

from me2e_compress import operators
from me2e_compress.errors import PreconditionError, RecipeError
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

    name: ClassVar[str] = "translate-plugins"
    exact: ClassVar[bool] = True

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

        def translate(fused: operators.FusedNode) -> bool:
            to = operators.dialect_of(fused.operator, self.dialect)
            if to is None:
                raise PreconditionError(self._lacks(fused))
            if to == fused.dialect:
                return False
            operators.translate(
                fused.node, to, opset=fused.opset, by=self.name, names=fused.names
            )
            return True

        return _rewritten(model, translate, f"in the dialect {self.dialect}")

    def _lacks(self, fused: operators.FusedNode) -> str:
        there = ", ".join(each.name for each in fused.operator.all_dialects())
        return (
            f"node {fused.node.name}: the dialect {self.dialect} has no"
            f" {fused.operator.name} ({fused.node.op_type}); it is in {there}"
        )


@dataclasses.dataclass(frozen=True)
class ExpandOperators(Pass):
    """Write every fused operator, of any dialect, in standard operators.

    Given:   y = me2e.MultiScaleDeformableAttention(value, sizes, starts, at, weights)
    Result:  y = Transpose(... ReduceSum(Mul(GridSample(value, 2 * at - 1), weights)))

    The graph's opset decides which operators are used: GridSample from opset 16 on
    where the sizes of the maps are constants, else Gather. A plugin that no dialect
    names is left alone.
    """

    name: ClassVar[str] = "expand-operators"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Expand the nodes of the graph, of its bodies and of its functions."""

        def expand(fused: operators.FusedNode) -> bool:
            operators.expand(
                fused.node, opset=fused.opset, by=self.name, names=fused.names
            )
            return True

        return _rewritten(model, expand, "expanded")


def _rewritten(
    model: ir.Model, rewrite_node: Callable[[operators.FusedNode], bool], said: str
) -> PassResult:
    """Rewrite fused nodes, count those that changed, and drop what nothing reads."""
    counts: Counter[str] = Counter()
    for fused in operators.fused_nodes(model):
        counts[fused.operator.name] += rewrite_node(fused)
    if counts.total():
        operators.import_domains(model)
        rewrite.sweep(model)
    done = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return PassResult(model, counts.total(), (f"{said}: {done}",) if done else ())
