"""Bring a graph of any origin into the form that the other passes expect."""

import dataclasses
from collections.abc import Iterator
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.graph.modules import assign
from me2e_compress.graph.nodes import is_plugin, nodes_in, nodes_of
from me2e_compress.graph.rewrite import lift_constants
from me2e_compress.graph.validity import ORIGINAL_DOMAIN, PLUGIN_DOMAIN
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.import_normalize import doubles

__all__ = [
    "ORIGINAL_DOMAIN",
    "PLUGIN_DOMAIN",
    "ImportNormalize",
    "needs_import",
    "with_own_domains",
]

_FUNCTIONS_SINCE_IR = 8
"""The first ONNX IR version whose models may hold functions (onnx/docs/IR.md)."""


@dataclasses.dataclass(frozen=True)
class ImportNormalize(Pass):
    """Give every node a name and an origin, and normalize the graph.

    1. Nodes without a name, or with a name that is taken, get one.
    2. Every node gets its module and its origin before anything renames it.
    3. Plugin nodes of the default domain move to ``me2e.plugin``; their metadata keep
       the old domain for the way back to TensorRT.
    4. float64 that leaked into a float32 graph becomes float32.
    5. Constant nodes become initializers.
    6. A model with functions declares at least IR version 8, and all used domains are
       imported.

    Subgraphs and function bodies are included. Unknown operators are left alone.

    Given:
        n = RotateTRT(x)  ;  c = Constant<double>()  ;  y = Mul(n, c)

    Result:
        n = me2e.plugin.RotateTRT(x)  ;  y = Mul(n, c)   with c a float32 initializer
    """

    name: ClassVar[str] = "import-normalize"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite the model in place."""
        changes = _name_nodes(model, self.name) + _stamp(model, context)
        changes += _isolate_plugins(model, self.name)
        demoted, note = doubles.demote(model, self.name)
        changes += demoted + lift_constants(model) + _declare(model)
        return PassResult(model, changes, (note,) if note else ())


def needs_import(model: ir.Model) -> bool:
    """Return whether nodes lack provenance, or plugins a domain of their own."""
    return bool(provenance.missing(model)) or any(
        _bare_plugins(body, model) for body in _bodies(model)
    )


def with_own_domains(model: ir.Model) -> ir.Model:
    """Return the graph, or a copy whose plugins have their old domains again."""
    if not any(ORIGINAL_DOMAIN in node.metadata_props for node in nodes_of(model)):
        return model
    copy = model.clone()
    for body in _bodies(copy):
        for node in nodes_in(body):
            if ORIGINAL_DOMAIN in node.metadata_props:
                node.domain = node.metadata_props.pop(ORIGINAL_DOMAIN)
        if all(node.domain != PLUGIN_DOMAIN for node in nodes_in(body)):
            body.opset_imports.pop(PLUGIN_DOMAIN, None)
    return copy


def _bodies(model: ir.Model) -> Iterator[ir.Graph | ir.Function]:
    yield model.graph
    yield from model.functions.values()


def _name_nodes(model: ir.Model, by: str) -> int:
    """Name nodes without a unique name; new names depend only on the order of nodes."""
    count = 0
    for body in _bodies(model):
        # Reserve all given names first
        nodes = list(nodes_in(body))
        reserved = {node.name for node in nodes if node.name}
        taken: set[str] = set()
        counters: dict[str, int] = {}
        for node in nodes:
            if node.name and node.name not in taken:
                taken.add(node.name)
                continue
            # Take the first free number
            stem = node.name or node.op_type
            number = counters.get(stem, 0)
            while f"{stem}_{number}" in reserved:
                number += 1
            counters[stem] = number + 1
            node.name = f"{stem}_{number}"
            reserved.add(node.name)
            taken.add(node.name)
            provenance.inherit(node, [node], by=by)
            count += 1
    return count


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


def _isolate_plugins(model: ir.Model, by: str) -> int:
    """Move plugins of the default domain to one of their own, and count them.

    They come from ``OperatorExportTypes.ONNX_FALLTHROUGH`` (BEVFormer_tensorrt, DL4AGX
    uniad-trt: ``MultiScaleDeformableAttnTRT``, ``RotateTRT``, ``InverseTRT``) or from a
    plugin symbolic without a domain (``MSDAPlugin``).
    """
    count = 0
    for body in _bodies(model):
        moved = _bare_plugins(body, model)
        for node in moved:
            node.metadata_props.setdefault(ORIGINAL_DOMAIN, node.domain)
            node.domain = PLUGIN_DOMAIN
            provenance.inherit(node, [node], by=by)
        if moved:
            body.opset_imports.setdefault(PLUGIN_DOMAIN, 1)
        count += len(moved)
    return count


def _bare_plugins(body: ir.Graph | ir.Function, model: ir.Model) -> list[ir.Node]:
    return [
        node
        for node in nodes_in(body)
        if node.domain == ""
        and is_plugin(node)
        and node.op_identifier() not in model.functions
    ]


def _declare(model: ir.Model) -> int:
    count = 0
    if model.functions and model.ir_version < _FUNCTIONS_SINCE_IR:
        model.ir_version = _FUNCTIONS_SINCE_IR
        count += 1
    for body in _bodies(model):
        for node in nodes_in(body):
            if node.domain not in body.opset_imports:
                body.opset_imports[node.domain] = 1
                count += 1
    return count
