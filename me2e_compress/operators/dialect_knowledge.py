"""Tell the graph room the shapes and costs of plugins whose dialect is known."""

import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.operators.lookup import find
from me2e_compress.operators.replace import set_output


class DialectKnowledge:
    """See :class:`me2e_compress.graph.shapes.PluginKnowledge`.

    A node that its dialect refuses counts as unknown.
    """

    def knows(self, node: ir.Node) -> bool:
        """Return whether a dialect has the node's operator."""
        return find(node) is not None

    def infer(self, node: ir.Node) -> bool:
        """Write the type and shape of a node's output; return whether any is new."""
        found = find(node)
        try:
            if found is not None:
                found[1].check(node)
                return set_output(node, *found)
        except PreconditionError:
            pass
        return False

    def macs(self, node: ir.Node) -> int | None:
        """Count a node's multiply-accumulates, if known."""
        found = find(node)
        try:
            return None if found is None else found[0].cost(node, found[1]).macs
        except PreconditionError:
            return None
