"""Layers between pairs, in the forms that onnxruntime's int8 rewrites."""

import dataclasses
from typing import Any

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from tests.support.nets import parsed, stored

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
        written = "" if self.without_zero == "input" else ", z"
        last = "r" if self.behind else "c"
        lines = [
            "xq = QuantizeLinear(x, s, z)",
            f"xd = DequantizeLinear(xq, s{written})",
            *self._operands(constants),
            *self._layer(),
            *([f"r = {self.behind}(c)"] if self.behind else []),
            *([f"a = QuantizeLinear({last}, t, z)", "y = DequantizeLinear(a, t, z)"]
              if self.answered else [f"y = Tanh({last})"]),
        ]  # fmt: skip
        arrays = {name: np.asarray(each) for name, each in constants.items()}
        ports = [f"float{list(self.shape)} x"]
        for name, each in arrays.items():
            kind = ir.DataType.from_numpy(each.dtype).name.lower()
            ports.append(f"{kind}{list(each.shape) or ''} {name}")
        head = f'<ir_version: 9, opset_import: ["" : {self.opset}]> m'
        inputs, body = ", ".join(ports), "\n".join(lines)
        model = stored(parsed(f"{head} ({inputs}) => (float[] y) {{ {body} }}"), arrays)
        graph.infer_shapes(model)
        return model

    def _operands(self, constants: dict[str, Any]) -> list[str]:
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
        # small integers of 7 bits do not overflow 16 on any processor
        integers = random.integers(-63, 64, size).astype(np.int8)
        if self.weight == "float":
            constants["w"] = random.normal(0, 0.2, size).astype(np.float32)
            lines = ["wd = Identity(w)"]
        else:
            zeros = np.zeros(scales.shape, np.int8)
            constants |= {"w": integers, "ws": scales, "wz": zeros}
            along = f"<axis={axis}>" if by_channel else ""
            written = "" if self.without_zero == "weight" else ", wz"
            lines = [f"wd = DequantizeLinear{along}(w, ws{written})"]
        if self.bias in ("own", "right"):
            own = self.bias == "own"
            units = np.asarray(0.001 if own else STEP * scales, np.float32)
            constants |= {"b": np.rint(bias / units).astype(np.int32), "bs": units}
            along = "<axis=0>" if np.ndim(units) else ""
            lines.append(f"bd = DequantizeLinear{along}(b, bs)")
        elif self.bias != "none":
            cast = self.constant == "Cast"
            constants["b"] = bias.astype(np.float64 if cast else np.float32)
            lines.append(f"bd = {'Cast<to=1>' if cast else 'Identity'}(b)")
        return lines

    def _layer(self) -> list[str]:
        if self.op == "Add":
            return ['["layer"] p = MatMul(xd, wd)', "c = Add(p, bd)"]
        turned = f"<transB={int(self.transposed)}>" if self.op == "Gemm" else ""
        third = "" if self.bias == "none" else ", bd"
        return [f'["layer"] c = {self.op}{turned}(xd, wd{third})']
