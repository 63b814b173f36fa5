"""Convolutions: deformable (v2, arXiv 1811.11168) and Winograd (arXiv 1509.09308)."""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.graph.shapes import Dims, open_shape, product
from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOAT32,
    FLOATS,
    INT8_TOO,
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
from me2e_compress.operators.grid_sampler import sample_levels_array
from me2e_compress.operators.kernels.kernel import DOMAIN

_NAMES = ("stride", "padding", "dilation")


def _options(groups: str, offset_groups: str) -> tuple[Attribute, ...]:
    return (
        Attribute("stride", (1, 1)),
        Attribute("padding", (0, 0)),
        Attribute("dilation", (1, 1)),
        Attribute(groups, 1, own="groups"),
        Attribute(offset_groups, 1, own="deform_groups"),
    )


def _operands(types: tuple[ir.DataType, ...]) -> tuple[Operand, ...]:
    return (
        Operand("input", "N C H W", types),
        Operand("offset", "N * F G", types, positions=True),
        Operand("mask", "N * F G", types),
        Operand("weight", "O I R S", types),
        Operand("bias", "O", types, optional=True),
    )


_OWN = _options("groups", "deform_groups")
_OSS = _options("group", "deformable_group")
_CONV, _MMCV = "ModulatedDeformConv2d", "MMCVModulatedDeformConv2d"
_LIBRARY = ("trt.plugins", _operands(FLOATS), "TensorRT OSS")
_MMDEPLOY = (_operands(FLOAT32), "mmcv")
_DERRYHUB = ("", _operands(INT8_TOO), "BEVFormer_tensorrt")
_TRT = "ModulatedDeformableConv2dTRT"


@dataclasses.dataclass(frozen=True)
class DeformableConvolution(Operator):
    """A convolution whose kernel elements are moved by offsets and weighted by a mask.

    Own form ``me2e::ModulatedDeformConv2d``: input [N, C, H, W]; offset
    [N, deform_groups * K * 2, F, G] (y, x), for K elements of the kernel; mask
    [N, deform_groups * K, F, G]; weight [O, C / groups, kernel height, width]; optional
    bias [O]; ``stride``, ``padding``, ``dilation`` (two each), ``groups``,
    ``deform_groups``. Output [N, O, F, G].
    """

    name = "deformable-convolution"
    output = "N O F G"
    work = "N O F G I R S"
    opset = 19
    own = Dialect("me2e", _CONV, OWN_DOMAIN, _operands(FLOATS), "me2e", _OWN)
    dialects = (
        Dialect("tensorrt", _CONV, *_LIBRARY, _OSS),
        Dialect("tensorrt-v2", _CONV, *_LIBRARY, _OSS, "2"),
        Dialect("mmdeploy", _MMCV, "mmdeploy", *_MMDEPLOY, _OWN),
        Dialect("mmcv", _MMCV, "mmcv", *_MMDEPLOY, _OWN),
        Dialect("derryhub", _TRT, *_DERRYHUB, _OWN),
        Dialect("derryhub-trt2", f"{_TRT}2", *_DERRYHUB, _OWN),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write ONNX's DeformConv."""
        image, offset, mask, weight = present(inputs[:4])
        bias = inputs[4] if len(inputs) > 4 else None
        down, across = numbers(attributes, "padding")
        options: dict[str, int | tuple[int, ...]] = {
            "strides": numbers(attributes, "stride"),
            "dilations": numbers(attributes, "dilation"),
            "pads": (down, across, down, across),
            "group": number(attributes, "groups"),
            "offset_group": number(attributes, "deform_groups"),
        }
        return call.add("DeformConv", [image, weight, offset, bias, mask], options)

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, O, F, G] float64."""
        image, offset, mask, weight, *bias = (
            np.asarray(value, np.float64) for value in inputs if value is not None
        )
        batch, deep, high, wide = image.shape
        down, across = offset.shape[2:]
        out, part, *elements = weight.shape
        count, places = math.prod(elements), down * across
        parts, groups = number(attributes, "deform_groups"), deep // part
        # Sample each kernel element at its moved position: K elements, F * G places
        options = [numbers(attributes, name) for name in _NAMES]
        y, x = (  # pixels: [F or G, rows or columns of the kernel]
            np.arange(size)[:, None] * stride - padding + np.arange(kernel) * dilation
            for size, kernel, stride, padding, dilation in zip(
                (down, across), elements, *options, strict=True
            )
        )
        grid = np.zeros((down, across, *elements, 2))
        grid[..., 0], grid[..., 1] = y[:, None, :, None], x[None, :, None, :]
        grid = grid.reshape(places, count, 1, 2)
        moved = offset.reshape(batch, parts, count, 2, places).transpose(0, 4, 2, 1, 3)
        at = (moved + grid)[..., ::-1] + 0.5  # [N, F * G, K, parts, 2], (x, y)
        shape = (batch, places * count, parts, 1, 1)
        shares = mask.reshape(batch, parts, count, places).transpose(0, 3, 2, 1)
        samples = sample_levels_array(
            image.reshape(batch, parts, -1, high * wide).transpose(0, 3, 1, 2),
            np.array([[high, wide]]),
            np.array([0]),
            (at / np.array([wide, high])).reshape(*shape, 2),
            shares.reshape(shape),
        )
        samples = samples.reshape(batch, places, count, groups, part)
        # Multiply the samples by the weight, group by group
        matrix = weight.reshape(groups, out // groups, part, count)
        result: NdArray = np.einsum("gock,npkgc->ngop", matrix, samples)
        result = result.reshape(batch, out, down, across)
        return np.add(result, bias[0].reshape(-1, 1, 1)) if bias else result


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
