"""Deformable convolutions (v2, arXiv 1811.11168)."""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

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
    Values,
    number,
    numbers,
    present,
)
from me2e_compress.operators.grid_sampler import sample_levels_array

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
