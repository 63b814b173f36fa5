"""Predict what int8 saves and costs on a GPU from published rates, not measured."""

import dataclasses
import math
from collections.abc import Collection, Mapping

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import CONVOLUTIONS, WEIGHTED, static_shape
from me2e_compress.graph.nodes import constant_values
from me2e_compress.quantization.costs import Border, Costs


@dataclasses.dataclass(frozen=True)
class GpuRates:
    """Peak rates of a GPU: dense multiply-accumulates and bytes per second."""

    machine: str
    half_macs: float
    int8_macs: float
    memory: float


MACHINES: Mapping[str, GpuRates] = {
    "orin": GpuRates("TensorRT on Orin, as predicted", 21.25e12, 42.5e12, 204.8e9),
}
"""Jetson AGX Orin 64 GB (NVIDIA's technical brief: 170 int8 TOPS of the GPU with
sparsity, 204.8 GB/s); a dense MAC is four of those operations, half the rate in
float16."""

_FUSED = frozenset({"Add", "BatchNormalization", "Clip", "MaxPool", "Relu"})
"""Operators that a convolution's kernel includes after it, or that pass int8 on."""


def costs_of(model: ir.Model, layers: Collection[ir.Node], rates: GpuRates) -> Costs:
    """Predict the savings and costs of int8 for some layers, compared with float16.

    A layer takes the longer of its arithmetic and memory time. The output of a
    convolution is quantized in its own kernel; any other producer writes one more byte
    per element, and a graph input is read once more. In the fused regions of
    transformers, a pair before a product moves its bias and what follows out of its
    kernel: its output is read and written once more, as measured on Orin for
    SparseDriveV2. Shapes are inferred.
    """
    constants = constant_values(model)
    layers = [layer for layer in layers if layer.op_type in WEIGHTED]
    saved: dict[ir.Node, float] = {}
    readers: dict[ir.Value, list[ir.Node]] = {}
    # Collect the saving of each layer, and the readers of tensors.
    for layer in layers:
        activations = [v for v in layer.inputs[:2] if v and v not in constants]
        for value in activations:
            readers.setdefault(value, []).append(layer)
        seconds = _saved_s(layer, rates)
        if seconds is not None:
            saved[layer] = seconds
    chosen = frozenset(layers)
    # Each tensor that layers read may need a pair.
    borders = tuple(
        _border(value, found, chosen, rates) for value, found in readers.items()
    )
    return Costs(rates.machine, saved, borders)


def _saved_s(layer: ir.Node, rates: GpuRates) -> float | None:
    macs = graph.macs(layer)
    shapes = [static_shape(v) for v in (*layer.inputs[:2], layer.outputs[0])]
    if macs is None or None in shapes:
        return None
    read, right, made = (math.prod(shape or ()) for shape in shapes)
    # The slower of arithmetic and memory decides.
    half_s = max(macs / rates.half_macs, 2 * (read + right + made) / rates.memory)
    int8_s = max(macs / rates.int8_macs, (read + right + 2 * made) / rates.memory)
    if layer.op_type not in CONVOLUTIONS:
        int8_s += 4 * made / rates.memory
    return half_s - int8_s


def _border(
    value: ir.Value,
    readers: list[ir.Node],
    chosen: Collection[ir.Node],
    rates: GpuRates,
) -> Border:
    elements = math.prod(static_shape(value) or ())
    producer, maker = value.producer(), _convolution(value)
    # A graph input is read once more.
    touched = 3 if producer is None else 1
    quantize_s = touched * elements / rates.memory
    others = any(reader not in chosen for reader in value.consumers())
    return Border(
        quantize_s,
        quantize_s,
        frozenset() if maker is None or maker not in chosen else frozenset({maker}),
        frozenset(readers),
        read_as_float=others or value.is_graph_output(),
    )


def _convolution(value: ir.Value) -> ir.Node | None:
    """Return the convolution whose kernel computes a tensor."""
    node = value.producer()
    while node is not None and node.op_type in _FUSED:
        sources = [each.producer() for each in node.inputs if each is not None]
        node = next((each for each in sources if each is not None), None)
    return node if node is not None and node.op_type in CONVOLUTIONS else None
