"""Layers between pairs, in the forms that onnxruntime's int8 rewrites."""

import dataclasses
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
from onnx import TensorProto, helper, numpy_helper

from me2e_compress import graph

SIZE = 8
"""Channels and columns."""

STEP = 0.02


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A layer between two pairs.

    Attributes:
        op: ``Conv``, ``ConvTranspose``, ``Gemm``, or ``Add``: a MatMul and its bias.
        weight: ``channel`` or ``tensor`` scales, or ``float``.
        bias: ``float``, ``far`` (beyond int32), ``own`` (int32 by its own scale),
            ``right`` (int32 by input times weight), or ``none``.
        bias_shape: of the bias.
        constant: the operator that gives a float bias.
        behind: the operator between the layer and its quantizer.
        answered: whether a pair follows; else the output is float.
        transposed: whether a Gemm's weight is.
        rows: whether a MatMul's input is [4, 16, SIZE].
        without_zero: the zero points that are not written: of ``input``, ``weight``.
    """

    op: str = "Conv"
    weight: str = "channel"
    bias: str = "float"
    bias_shape: tuple[int, ...] = (SIZE,)
    constant: str = ""
    behind: str = ""
    answered: bool = True
    transposed: bool = False
    rows: bool = False
    without_zero: str = ""
    kind: str = "uint8"
    opset: int = 17
    seed: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape of the input."""
        if self.op.startswith("Conv"):
            return (1, SIZE, 9, 9)
        return (4, 16, SIZE) if self.rows else (64, SIZE)

    def frame(self) -> dict[str, Any]:
        """Draw an input."""
        random = np.random.default_rng(self.seed + 1)
        return {"x": random.normal(size=self.shape).astype(np.float32)}

    def model(self) -> ir.Model:
        """Build the graph."""
        zero = np.array(128 if self.kind == "uint8" else 0, self.kind)
        constants: dict[str, Any] = {"s": np.float32(STEP), "z": zero}
        constants["t"] = np.float32(0.06)
        zeros = [] if self.without_zero == "input" else ["z"]
        nodes = [
            helper.make_node("QuantizeLinear", ["x", "s", "z"], ["xq"]),
            helper.make_node("DequantizeLinear", ["xq", "s", *zeros], ["xd"]),
            *self._operands(constants),
            *self._layer(),
        ]
        last = "c"
        if self.behind:
            nodes.append(helper.make_node(self.behind, ["c"], ["r"]))
            last = "r"
        if self.answered:
            nodes.append(helper.make_node("QuantizeLinear", [last, "t", "z"], ["a"]))
            nodes.append(helper.make_node("DequantizeLinear", ["a", "t", "z"], ["y"]))
        else:
            nodes.append(helper.make_node("Tanh", [last], ["y"]))
        ports = [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
            for name, shape in (("x", self.shape), ("y", None))
        ]
        stored = [
            numpy_helper.from_array(np.asarray(a), n) for n, a in constants.items()
        ]
        made = helper.make_graph(nodes, "m", ports[:1], ports[1:], stored)
        opset = [helper.make_opsetid("", self.opset)]
        proto: onnx.ModelProto = helper.make_model(
            made, opset_imports=opset, ir_version=9
        )
        model = ir.from_proto(proto)
        graph.infer_shapes(model)
        return model

    def _operands(self, constants: dict[str, Any]) -> list[onnx.NodeProto]:
        """Store weight and bias, and return the nodes that give them."""
        random = np.random.default_rng(self.seed)
        size = (SIZE, SIZE, 3, 3) if self.op.startswith("Conv") else (SIZE, SIZE)
        axis = 0 if self.op == "Conv" or self.transposed else 1
        by_channel = self.weight == "channel"
        scales = random.uniform(0.002, 0.004, SIZE if by_channel else ())
        if self.bias == "far":
            scales = scales * np.where(np.arange(SIZE) == 3, 1e-10, 1.0)
            scales = scales if by_channel else scales[3]
        scales = scales.astype(np.float32)
        bias = random.uniform(1, 3, self.bias_shape)
        along: dict[str, Any] = {"axis": axis} if by_channel else {}
        # small integers of 7 bits do not overflow 16 on any processor
        integers = random.integers(-63, 64, size).astype(np.int8)
        constants |= {"w": integers, "ws": scales, "wz": np.zeros(scales.shape, "i1")}
        stored = ["w", "ws"] if self.without_zero == "weight" else ["w", "ws", "wz"]
        nodes = [helper.make_node("DequantizeLinear", stored, ["wd"], **along)]
        if self.weight == "float":
            constants["w"] = random.normal(0, 0.2, size).astype(np.float32)
            nodes = [helper.make_node("Identity", ["w"], ["wd"])]
        if self.bias in ("own", "right"):
            own = self.bias == "own"
            units = np.asarray(0.001 if own else STEP * scales, np.float32)
            constants |= {"b": np.rint(bias / units).astype(np.int32), "bs": units}
            along = {"axis": 0} if np.ndim(units) else {}
            nodes += [
                helper.make_node("DequantizeLinear", ["b", "bs"], ["bd"], **along)
            ]
        elif self.bias != "none":
            wide = np.float64 if self.constant == "Cast" else np.float32
            constants["b"] = bias.astype(wide)
            to: dict[str, Any] = (
                {"to": TensorProto.FLOAT} if self.constant == "Cast" else {}
            )
            given = self.constant or "Identity"
            nodes += [helper.make_node(given, ["b"], ["bd"], **to)]
        return nodes

    def _layer(self) -> list[onnx.NodeProto]:
        third = [] if self.bias == "none" else ["bd"]
        inputs = ["xd", "wd", *third]
        if self.op == "Add":
            return [
                helper.make_node("MatMul", inputs[:2], ["p"], name="layer"),
                helper.make_node("Add", ["p", "bd"], ["c"]),
            ]
        options: dict[str, Any] = {}
        if self.op == "Gemm":
            options = {"transB": int(self.transposed)}
        return [helper.make_node(self.op, inputs, ["c"], name="layer", **options)]
