"""Write constants and new nodes into a graph during lowering."""

import hashlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.graph import provenance

BY = "quantize-int8"


class Writer:
    """Writes into one graph; equal constants are stored once."""

    def __init__(self, where: ir.Graph) -> None:
        self.graph = where
        self._constants: dict[tuple[str, bytes], ir.Value] = {}
        self._names = rewrite.value_names(where)

    def constant(self, array: npt.NDArray[np.generic], name: str) -> ir.Value:
        """Return the initializer of an array, or add one."""
        kind = f"{array.dtype}{array.shape}"
        key = (kind, hashlib.sha256(array.tobytes()).digest())
        if key not in self._constants:
            self._constants[key] = rewrite.add_constant(
                self.graph, array, name, self._names
            )
        return self._constants[key]

    def node(
        self,
        op: str,
        inputs: Sequence[ir.Value],
        name: str,
        sources: Sequence[ir.Node],
        attributes: dict[str, int] | None = None,
    ) -> ir.Node:
        """Build a node with a unique name and the sources' provenance."""
        unique = rewrite.fresh_name(name, self._names)
        node = ir.node(op, inputs, attributes or {}, name=unique)
        node.outputs[0].name = unique
        provenance.inherit(node, sources, by=BY)
        return node

    def dequantized(
        self,
        name: str,
        integers: npt.NDArray[np.generic],
        scales: npt.NDArray[np.float32],
        axis: int | None,
        reader: ir.Node,
    ) -> ir.Value:
        """Store integers and insert their DequantizeLinear before the reader.

        ``scales`` is float32 [channels] along ``axis`` of the integers, or a scalar
        with ``axis`` None. Returns the dequantized tensor.
        """
        zeros = np.zeros(scales.shape, integers.dtype)
        stored = self.constant(integers, f"{name}_{integers.dtype}")
        steps = self.constant(scales, f"{name}_scale")
        inputs = [stored, steps, self.constant(zeros, f"{name}_zero")]
        axes = None if axis is None else {"axis": axis}
        # The node is named after its reader: weights may be shared.
        label = f"{reader.name or reader.outputs[0].name}/{name}_float"
        node = self.node("DequantizeLinear", inputs, label, [reader], axes)
        node.outputs[0].shape = ir.Shape(integers.shape)
        node.outputs[0].dtype = ir.DataType.FLOAT
        self.graph.insert_before(reader, node)
        return node.outputs[0]
