"""A random graph: motifs of exporters, one reading what others gave."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence

import onnx
from onnx import helper

from tests.fuzz.exact.builder import SCOPES, Builder, Shared, TooLargeError, Val
from tests.fuzz.exact.motifs import attention, bodies, layers, oddities, rows

Motif = Callable[[Builder], None]

MOTIFS: Mapping[str, tuple[Motif, float]] = {
    "one-layer": (layers.one_layer, 2), "layers-in-a-row": (layers.layers_in_a_row, 2),
    "on-positions": (layers.on_positions, 2), "on-columns": (layers.on_columns, 2),
    "on-points": (layers.on_points, 1.5), "same-source": (layers.same_source, 2),
    "repeated-rows": (rows.repeated_rows, 6),
    "repeated-layer": (rows.repeated_layer, 3), "layer-norm": (layers.layer_norm, 1.5),
    "gelu": (layers.gelu, 1.5), "swish": (layers.swish, 1),
    "hard-swish": (layers.hard_swish, 1), "mish": (layers.mish, 1),
    "constant-chain": (layers.constant_chain, 2),
    "conv-and-norm": (layers.conv_and_norm, 2.5),
    "shared-kernel": (layers.shared_kernel, 3),
    "shared-square": (layers.shared_square, 2.5),
    "alias-of-a-weight": (layers.alias_of_a_weight, 1),
    "gathered-batches": (rows.gathered_batches, 0.7),
    "attention": (attention.attention, 3),
    "shared-operand": (attention.shared_operand, 2),
    "computed-reshape": (rows.computed_reshape, 1.5), "filled": (rows.filled, 1),
    "counted": (rows.counted, 1), "expanded-by-shape": (rows.expanded_by_shape, 1),
    "sliced-by-shape": (rows.sliced_by_shape, 1), "given-back": (rows.given_back, 0.5),
    "no-ops": (oddities.no_ops, 2), "pairs": (oddities.pairs, 2),
    "twins": (oddities.twins, 1.5), "empty-inputs": (oddities.empty_inputs, 1),
    "odd-constants": (oddities.odd_constants, 1.5), "branches": (oddities.branches, 1),
    "grown-by-a-constant": (oddities.grown_by_a_constant, 1.5),
    "odd-products": (oddities.odd_products, 1.5), "full-bias": (oddities.full_bias, 1),
    "cast-about": (oddities.cast_about, 1), "defaults": (oddities.defaults, 1),
    "if": (bodies.branch, 2.5), "loop": (bodies.loop, 1),
    "function": (bodies.called, 1), "deformable": (attention.decomposed, 3),
    "rotated-view": (attention.rotated_view, 2), "plugin": (attention.plugin, 2),
}  # fmt: skip
"""What a graph is composed of, and how often each is drawn beside the others."""

IR_OF_OPSET = ((21, 10), (19, 9), (15, 8), (12, 7), (11, 6))
"""The IR version that came with an opset."""

MOST_NODES = 36
"""No motif is begun beyond this."""


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A graph and what it was made of."""

    model: onnx.ModelProto
    motifs: tuple[str, ...]


def draw(seed: int) -> onnx.ModelProto:
    """Draw a graph; the same seed gives the same bytes."""
    return drawing(seed).model


def drawing(seed: int) -> Drawing:
    """Draw a graph and tell its motifs."""
    b = Builder(Shared(seed))
    names = list(MOTIFS)
    weights = [MOTIFS[name][1] for name in names]
    for _ in range(b.rng.choice((1, 1, 2, 2, 3, 3, 4, 5))):
        if len(b.nodes) > MOST_NODES:
            break
        (name,) = b.rng.choices(names, weights)
        b.scope = b.rng.choice(SCOPES)
        before = len(b.nodes)
        with contextlib.suppress(TooLargeError):
            MOTIFS[name][0](b)
        if len(b.nodes) > before:
            b.shared.motifs.append(name)
    if not b.nodes:
        MOTIFS["one-layer"][0](b)
    return Drawing(_model(b), tuple(b.shared.motifs))


def _outputs(b: Builder) -> list[Val]:
    """Choose what is given: most of what nothing reads, and some that is read."""
    read = {name for node in b.nodes for name in _read(node)}
    made = [each for each in b.values if each not in b.inputs]
    ends = [each for each in made if each.name not in read]
    given = [each for each in ends if b.chance(0.9)] or ends[-1:]
    given += [each for each in made if each.name in read and b.chance(0.06)]
    if b.inputs and b.chance(0.04):
        given.append(b.rng.choice(b.inputs))
    if b.weights and b.chance(0.03):
        given.append(b.rng.choice(b.weights))
    return given


def _read(node: onnx.NodeProto) -> Sequence[str]:
    inner = [
        name
        for attribute in node.attribute
        if attribute.type == onnx.AttributeProto.GRAPH
        for each in attribute.g.node
        for name in _read(each)
    ]
    return [*node.input, *inner]


def _model(b: Builder) -> onnx.ModelProto:
    graph = b.graph(_outputs(b), "drawn")
    opset = b.opset
    least = next(ir for since, ir in IR_OF_OPSET if opset >= since)
    imports = [helper.make_opsetid("", opset)]
    imports += [helper.make_opsetid(*each) for each in b.shared.domains.items()]
    if b.shared.listed_weights:
        _list_weights(b, graph)
    if b.shared.functions:
        least = max(least, 8)
    version = max(least, b.rng.choice((least, 8, 9, 10)))
    return helper.make_model(
        graph,
        opset_imports=imports,
        ir_version=version,
        functions=b.shared.functions,
        producer_name="drawn",
    )


def _list_weights(b: Builder, graph: onnx.GraphProto) -> None:
    """Name weights among the inputs too, as old exporters do."""
    for tensor in graph.initializer:
        if b.chance(0.8):
            kind, dims = tensor.data_type, list(tensor.dims)
            graph.input.append(helper.make_tensor_value_info(tensor.name, kind, dims))
