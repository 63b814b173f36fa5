"""The inverse of small matrices, for example of cameras."""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph.shapes import Dims, product
from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOAT32,
    FLOATS,
    OWN_DOMAIN,
    Arrays,
    Dialect,
    NdArray,
    Operand,
    Shapes,
    Values,
    present,
)

_LARGEST = 16  # largest n: the n * n minors of (n - 1) x (n - 1) numbers take n^5 work

_ANY, _EITHER = (
    (Operand("matrix", None, types, positions=True),) for types in (FLOAT32, FLOATS)
)
_BATCHES = (Operand("matrix", "B C n n", FLOAT32, positions=True),)


@dataclasses.dataclass(frozen=True)
class Inverse(Operator):
    """The inverse of square matrices.

    Own form ``me2e::Inverse``: matrix [..., n, n], n known and at most 16; output of
    the same shape. The body divides the cofactors, each a determinant (ONNX's Det), by
    the determinant.
    """

    name = "inverse"
    own = Dialect("me2e", "Inverse", OWN_DOMAIN, _ANY, "me2e")
    dialects = (
        *(
            Dialect(name, "InverseTRT", "", _BATCHES, "BEVFormer_tensorrt")
            for name in ("derryhub", "derryhub-trt2", "dl4agx-uniad")
        ),
        Dialect("dl4agx", "InversePlugin", "custom_op", _ANY, "DL4AGX"),
        Dialect("onnxruntime", "Inverse", "com.microsoft", _EITHER, "onnxruntime"),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write the adjugate over the determinant; the size must be known and small."""
        (matrix,) = present(inputs)
        kind = matrix.dtype or ir.DataType.FLOAT
        if kind == ir.DataType.FLOAT16:  # onnxruntime has no kernel for it
            matrix = call.cast(matrix, ir.DataType.FLOAT)
        size = call.size(matrix, -1)
        if not isinstance(size, int) or not 0 < size <= _LARGEST:
            raise PreconditionError(
                f"node {call.node.name}: matrices of {matrix.name} must be of a known"
                f" size up to {_LARGEST}"
            )
        if size == 1:
            return call.cast(call.add("Reciprocal", [matrix]), kind)
        # Element (i, j): (-1)^(i + j) times the minor without row j and column i
        rank = len(matrix.shape) if matrix.shape is not None else 2
        outer = tuple(call.size(matrix, axis) for axis in range(rank - 2))
        flat = call.reshape(matrix, (*outer, size * size))
        others = np.array([[j for j in range(size) if j != i] for i in range(size)])
        rows, columns = others[None, :, :, None], others[:, None, None, :]
        index = call.constant(rows * size + columns)  # [n, n, n - 1, n - 1]
        minors = call.add("Gather", [flat, index], {"axis": -1})
        parity = np.indices((size, size)).sum(axis=0) % 2
        signs = call.numbers(1 - 2 * parity, matrix)
        adjugate = call.add("Mul", [call.add("Det", [minors]), signs])
        whole = call.unsqueeze(call.add("Det", [matrix]), (rank - 2, rank - 1))
        return call.cast(call.add("Div", [adjugate, whole]), kind)

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, float64."""
        return np.linalg.inv(np.asarray(inputs[0], np.float64))

    def output_shape(self, shapes: Shapes, attributes: Attributes) -> Dims | None:
        """Return the shape of the matrices."""
        return shapes[0]

    def macs(self, shapes: Shapes, attributes: Attributes) -> int | None:
        """Count n cubed for each matrix, the work of an elimination."""
        shape = shapes[0]
        return None if shape is None else product((*shape, shape[-1]))
