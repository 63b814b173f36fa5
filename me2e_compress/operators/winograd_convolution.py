"""3x3 convolution by Winograd's algorithm (Lavin and Gray, arXiv 1509.09308)."""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.graph.shapes import Dims, open_shape, product
from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    OWN_DOMAIN,
    Arrays,
    Attribute,
    Dialect,
    NdArray,
    Operand,
    Shapes,
    Values,
    number,
    numbers,
    present,
)
from me2e_compress.operators.kernels.kernel import DOMAIN

FILTER = 3  # rows and columns of a filter


@dataclasses.dataclass(frozen=True)
class WinogradConvolution(Operator):
    """A convolution with filters of 3 x 3 at stride 1, with 4 times fewer products.

    Own form ``me2e::WinogradConvolution``, inputs as of ONNX's Conv: X [N, C, H, W];
    W [K, C, 3, 3]; B [K]. Attributes: ``pads`` (top, left, bottom, right), and
    ``relu``, 1 for negative results to become 0. Output [N, K, H', W']: H' is H + top
    + bottom - 2, W' likewise.

    The body is a Conv. The compiled kernel is F(4x4, 3x3) in float32: its results have
    117 to 124 dB of SQNR where a Conv's have 131 to 139 (inputs and filters normally
    distributed, 64 to 512 channels).
    """

    name = "winograd-convolution"
    own = Dialect(
        "me2e", "WinogradConvolution", OWN_DOMAIN,
        (Operand("X", "N C H W"), Operand("W", "K C 3 3"), Operand("B", "K")), "me2e",
        (Attribute("pads", (0, 0, 0, 0)), Attribute("relu", 0, choices=(0, 1))),
    )  # fmt: skip
    dialects = ()

    def output_shape(self, shapes: Shapes, attributes: Attributes) -> Dims | None:
        """Return [N, K, H', W'], smaller than the padded image by 2."""
        batch, out, *image = self._sizes("N K H W", shapes, attributes)
        pads = numbers(attributes, "pads")
        sizes = (
            None if size is None else size + pads[axis] + pads[axis + 2] - FILTER + 1
            for axis, size in enumerate(image)
        )
        return (batch, out, *sizes)

    def macs(self, shapes: Shapes, attributes: Attributes) -> int | None:
        """Count those of the convolution, not of the algorithm."""
        dims = self.output_shape(shapes, attributes)
        (channels,) = self._sizes("C", shapes, attributes)
        return None if dims is None else product((*dims, channels, FILTER, FILTER))

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write the kernel's call, or a Conv and a Relu."""
        image, weight, bias = present(inputs)
        pads, relu = numbers(attributes, "pads"), number(attributes, "relu")
        if call.compiled and image.dtype in (None, ir.DataType.FLOAT):
            dims = self.output_shape(list(map(open_shape, inputs)), attributes)
            # The kernel reads filters beside each other: [3, 3, C, K]
            order, known = (2, 3, 1, 0), array_of(weight)
            if known is None:
                weight = call.transpose(weight, order)
            else:
                weight = call.constant(np.ascontiguousarray(known.transpose(order)))
            operands = [image, weight, bias, call.integers((*pads, relu))]
            result = call.add(self.own.op_type, operands, domain=DOMAIN)
            result.shape = None if dims is None else ir.Shape(dims)
            result.type = ir.TensorType(ir.DataType.FLOAT)
            return result
        result = call.add("Conv", [image, weight, bias], {"pads": list(pads)})
        return call.add("Relu", [result]) if relu else result

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, K, H', W'] float64."""
        image, weight, bias = (
            np.asarray(value, np.float64) for value in inputs if value is not None
        )
        top, left, bottom, right = numbers(attributes, "pads")
        padded = np.pad(image, ((0, 0), (0, 0), (top, bottom), (left, right)))
        window = (FILTER, FILTER)
        patches = np.lib.stride_tricks.sliding_window_view(padded, window, (2, 3))
        result: NdArray = np.einsum("nchwij,kcij->nkhw", patches, weight, optimize=True)
        result = result + bias[:, None, None]
        return np.maximum(result, 0) if number(attributes, "relu") else result
