"""What is known of operators that ONNX does not have: plugins and fused operators."""

import pkgutil
from typing import Protocol

import onnx_ir as ir


class PluginKnowledge(Protocol):
    """Answers for the nodes that it knows."""

    def knows(self, node: ir.Node) -> bool:
        """Return whether it knows a node's operator."""
        ...

    def infer(self, node: ir.Node) -> bool:
        """Write type and shape of what a node gives; return whether anything is new."""
        ...

    def macs(self, node: ir.Node) -> int | None:
        """Count a node's multiply-accumulates; None where they are not known."""
        ...


def knowledge() -> PluginKnowledge:
    """Return what the room of the fused operators says.

    That room stands above this one, and is found by its name, as registries find
    their entries; a graph without plugins never imports it.
    """
    found: PluginKnowledge = pkgutil.resolve_name(
        "me2e_compress.operators.dialect_knowledge:DialectKnowledge"
    )()
    return found
