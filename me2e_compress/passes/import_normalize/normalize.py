"""The pass itself: six steps, of which each leaves alone what is already so."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.modules import assign
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.import_normalize import constants, doubles, names, plugins
from me2e_compress.passes.import_normalize.bodies import bodies

_FUNCTIONS_SINCE_IR = 8
"""The first ONNX IR version whose models may hold functions (onnx/docs/IR.md)."""


@dataclasses.dataclass(frozen=True)
class ImportNormalize(Pass):
    """Give every node a name and a past, and spell four things the one right way.

    1. Nodes without a name, or with one that is taken, get one.
    2. Every node is told its module and its origin, before anything renames it.
    3. Plugin nodes of the default domain move to ``me2e.plugin``; the domain that
       they had stays in their metadata, for the way back to TensorRT.
    4. float64 that leaked into a graph of float32 becomes float32.
    5. Constant nodes become initializers.
    6. A model with functions says at least IR version 8, and every domain in use is
       imported.

    Subgraphs and function bodies are covered. Unknown operators are carried through.

    Given:
        n = RotateTRT(x)  ;  c = Constant<double>()  ;  y = Mul(n, c)
    Result:
        n = me2e.plugin.RotateTRT(x)  ;  y = Mul(n, c)   with c a float32 initializer
    """

    name: ClassVar[str] = "import-normalize"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite the model in place.

        Raises:
            ModuleMapError: the module map does not fit the graph.
        """
        changes = names.name_nodes(model, self.name) + _stamp(model, context)
        changes += plugins.isolate(model, self.name)
        demoted, note = doubles.demote(model, self.name)
        changes += demoted + constants.lift(model) + _declare(model)
        return PassResult(model, changes, (note,) if note else ())


def _stamp(model: ir.Model, context: Context) -> int:
    if not provenance.missing(model):
        return 0
    count = 0
    for node, place in assign(model, context.modules).placements.items():
        if provenance.read(node) is None:
            past = provenance.Provenance(place.module, (node.name or "",))
            provenance.stamp(node, past)
            count += 1
    return count


def _declare(model: ir.Model) -> int:
    count = 0
    if model.functions and model.ir_version < _FUNCTIONS_SINCE_IR:
        model.ir_version = _FUNCTIONS_SINCE_IR
        count += 1
    for body in bodies(model):
        for node in body.all_nodes():
            if node.domain not in body.opset_imports:
                body.opset_imports[node.domain] = 1
                count += 1
    return count
