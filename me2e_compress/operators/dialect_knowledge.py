"""What the graph asks of plugins: shapes and cost, where their dialect is known."""

import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.operators.lookup import find
from me2e_compress.operators.replace import set_output


class DialectKnowledge:
    """See :class:`me2e_compress.graph.plugins.PluginKnowledge`.

    A node that its dialect refuses is one that nobody knows: whoever rewrites it says
    what is wrong.
    """

    def knows(self, node: ir.Node) -> bool:
        """Return whether a node's operator is in one of the dialects."""
        return find(node) is not None

    def infer(self, node: ir.Node) -> bool:
        """Write type and shape of what a node gives; return whether anything is new."""
        found = find(node)
        try:
            if found is not None:
                found[1].check(node)
                return set_output(node, *found)
        except PreconditionError:
            pass
        return False

    def macs(self, node: ir.Node) -> int | None:
        """Count a node's multiply-accumulates; None where they are not known."""
        found = find(node)
        try:
            return None if found is None else found[0].cost(node, found[1]).macs
        except PreconditionError:
            return None
