"""Estimate what int8 saves and costs on onnxruntime's CPU, from operation counts."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import constant_values, sole_reader
from me2e_compress.operators import find, int8_inputs
from me2e_compress.quantization.costs import Border, Costs, Join, Layers
from me2e_compress.targets.onnxruntime.lower import PACKED, blocks_of
from me2e_compress.targets.onnxruntime.region import JOINS, Region, end_of, find_region

# Float32 feature maps up to this size are sampled as fast as uint8 ones: one core's
# share of the second-level cache
CACHE_BYTES = 2**21

# How often each constant of `CpuSeconds` is added
Counts: TypeAlias = Mapping[str, int]


@dataclasses.dataclass(frozen=True)
class CpuSeconds:
    """Nanoseconds of one core for one unit of work.

    Attributes:
        float_reorder: an element passed between a convolution, which works on channels
            in blocks, and anything else.
        float_sampled_mac: a multiply-accumulate of a fused operator that samples
            feature maps too large for the cache.
    """

    machine: str
    kernel: float  # any kernel call
    float_mac: float
    float_grouped_mac: float
    float_element: float  # an element that a layer reads or writes
    float_reorder: float
    float_weight: float
    int8_mac: float
    int8_grouped_mac: float
    int8_uneven_mac: float  # one over channels that are no multiple of four
    int8_patch: float  # a pixel copied into place for a kernel larger than 1
    int8_answer: float  # an element that a convolution rounds to uint8
    int8_product: float  # a float32 output element of a matrix product
    int8_weight: float
    float_sampled_mac: float
    int8_sampled_mac: float
    int8_cached_mac: float  # what uint8 adds to one on maps in the cache
    quantize: float
    dequantize: float

    def seconds(self, counts: Counts) -> float:
        """Return the time of some work."""
        return 1e-9 * sum(float(getattr(self, name)) * n for name, n in counts.items())


# Fitted to single layers and chains on an AMD EPYC (Zen 5), onnxruntime 1.31, by
# `python -m benchmarks.tools.fit_cpu_costs`; sampling by hand, to the results of
# `python -m benchmarks.measure.int8_sampling`, uneven channels to a Xeon (Sapphire
# Rapids), where what int8 writes and converts is twice as dear beside a multiplication.
# Its own constants were right about 89 to 91 % of layers there, as these are.
ZEN5 = CpuSeconds(
    machine="onnxruntime (one core with VNNI)",
    kernel=300,
    float_mac=0.009,
    float_grouped_mac=0.012,
    float_element=0.04,
    float_reorder=0.05,
    float_weight=0.015,
    int8_mac=0.0023,
    int8_grouped_mac=0.023,
    int8_uneven_mac=0.0035,
    int8_patch=1.1,
    int8_answer=0.06,
    int8_product=0.3,
    int8_weight=0.008,
    float_sampled_mac=0.1,
    int8_sampled_mac=0.075,
    int8_cached_mac=0.003,
    quantize=0.1,
    dequantize=0.17,
)


def costs_of(
    model: ir.Model, chosen: Collection[ir.Node], machine: CpuSeconds = ZEN5
) -> Costs:
    """Estimate what int8 of layers saves and costs; without a kernel: nothing."""
    weights = constant_values(model)
    names = {
        str(node.outputs[0].name)
        for node in chosen
        if node.inputs[1] in weights or int8_inputs(node)
    }
    # Layers save their arithmetic, sampling operators their reads.
    region = find_region(model.graph, names)
    works = {layer: work_of(layer) for layer in region.layers}
    works |= {node: sampled_work(node) for node in region.sampled.values()}
    saved = {
        node: machine.seconds(work[0]) - machine.seconds(work[1])
        for node, work in works.items()
        if work is not None
    }
    # Each uint8 tensor may cost a conversion at its border.
    around = _Surroundings(region)
    borders = tuple(around.border(value, machine) for value in region.grids)
    return Costs(machine.machine, saved, borders)


def work_of(layer: ir.Node) -> tuple[Counts, Counts] | None:
    """Count the work of a layer in float and in int8; None where shapes are open."""
    macs, result = graph.macs(layer), static_shape(layer.outputs[0])
    image, weight = static_shape(layer.inputs[0]), static_shape(layer.inputs[1])
    if macs is None or image is None or weight is None or result is None:
        return None
    inputs, outputs, weights = map(math.prod, (image, result, weight))
    float_ = {"kernel": 1, "float_element": inputs + outputs, "float_weight": weights}
    int8 = {"kernel": 1, "int8_weight": weights}
    # Products give float32; convolutions write uint8.
    if layer.op_type != "Conv":
        float_ |= {"float_mac": macs}
        int8 |= {"int8_mac": macs, "int8_product": outputs}
        return float_, int8
    # A float convolution reorders what it exchanges with others than convolutions.
    source, end, reordered = graph.producer_of(layer.inputs[0]), end_of(layer), 0
    if source is None or source.op_type not in (*_BLOCKED, "Clip", "Relu"):
        reordered += inputs
    if not any(reader.op_type in _BLOCKED for reader in end.consumers()):
        reordered += math.prod(static_shape(end) or ())
    grouped = "grouped_" if layer.attributes.get_int("group", 1) > 1 else ""
    float_ |= {f"float_{grouped}mac": macs, "float_reorder": reordered}
    uneven = weight[1] % PACKED and blocks_of(layer) is None
    kind = grouped or "uneven_" * bool(uneven)
    int8 |= {f"int8_{kind}mac": macs, "int8_answer": outputs}
    # Kernels larger than 1 copy patches first.
    taps = math.prod(weight[2:])
    if taps > 1 and not grouped:
        int8["int8_patch"] = taps * outputs // weight[0]
    return float_, int8


def sampled_work(node: ir.Node) -> tuple[Counts, Counts] | None:
    """Count a fused operator's work in float and in int8; None where it is unknown."""
    # On maps that fit the cache, only the conversion of the integers is counted
    plugin, shape = find(node), static_shape(node.inputs[0])
    macs = None if plugin is None else plugin[0].cost(node, plugin[1]).macs
    if macs is None or shape is None:
        return None
    if 4 * math.prod(shape[1:]) > CACHE_BYTES:
        return {"float_sampled_mac": macs}, {"int8_sampled_mac": macs}
    return {}, {"int8_cached_mac": macs}


# Operators that onnxruntime computes on blocks of channels, as convolutions
_BLOCKED = frozenset(
    ["Add", "AveragePool", "Concat", "Conv", "GlobalAveragePool", "MaxPool", "Mul"]
)


class _Surroundings:
    """Follows the uint8 tensors of a region to the layers before and after them."""

    def __init__(self, region: Region) -> None:
        self._region = region
        self._layers = {end_of(layer): layer for layer in region.layers}
        self._carriers = {end_of(node): node for node in region.readers}
        self._makers: dict[ir.Value, Layers] = {}
        self._readers: dict[ir.Value, Layers] = {}

    def border(self, value: ir.Value, machine: CpuSeconds) -> Border:
        """Describe one of the tensors."""
        elements = math.prod(static_shape(value) or ())
        direct, carriers, others = self._uses(value)
        # Joins connect this tensor's layers with those of others
        ends = [end_of(node) for node in carriers if node.op_type in JOINS]
        joins = tuple(Join(self.makers(end), self.readers(end)) for end in ends)
        # A product that is sampled is a convolution, whose rounding costs no more than
        # the float32 that it would write
        rounded = 0 if self._is_product(value) else elements
        return Border(
            machine.seconds({"kernel": 1, "quantize": rounded}),
            machine.seconds({"kernel": 1, "dequantize": elements}),
            self.makers(value),
            frozenset(direct),
            joins,
            others + value.is_graph_output(),
        )

    def _is_product(self, value: ir.Value) -> bool:
        """Return whether a product gives uint8 only because of sampling."""
        reader, node = sole_reader(value), value.producer()
        if node is None or reader not in self._region.sampled:
            return False
        before = map(graph.producer_of, node.inputs)
        products = (node, *before) if node.op_type == "Add" else (node,)
        return any(product in self._region.layers for product in products)

    def makers(self, value: ir.Value) -> Layers:
        """Return the nearest layers that a tensor comes from."""
        if value in self._makers:
            return self._makers[value]
        self._makers[value] = frozenset()
        node = self._carriers.get(value)
        if value in self._layers and value in self._region.written:
            self._makers[value] = frozenset({self._layers[value]})
        elif node is not None:
            inputs = node.inputs if node.op_type in JOINS else node.inputs[:1]
            sides = [side for side in inputs if side is not None]
            near = frozenset(self._layers[v] for v in sides if v in self._layers)
            self._makers[value] = near or frozenset().union(*map(self.makers, sides))
        return self._makers[value]

    def readers(self, value: ir.Value) -> Layers:
        """Return the nearest layers that read a tensor, through joins and moves."""
        if value not in self._readers:
            direct, carriers, _ = self._uses(value)
            behind = map(self.readers, map(end_of, carriers))
            self._readers[value] = frozenset(direct) or frozenset().union(*behind)
        return self._readers[value]

    def _uses(self, value: ir.Value) -> tuple[list[ir.Node], list[ir.Node], int]:
        """Sort the readers of a tensor into layers, carriers of uint8, and others."""
        layers: list[ir.Node] = []
        carriers: list[ir.Node] = []
        others = 0
        # onnxruntime converts anew for each float reader.
        for reader, index in value.uses():
            if not self._region.reads(reader, index):
                others += 1
            elif reader in self._region.layers:
                layers.append(reader)
            elif reader in self._region.sampled:
                layers.append(self._region.sampled[reader])
            else:
                carriers.append(reader)
        return layers, carriers, others
