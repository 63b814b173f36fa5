"""Find the layers that produce positions."""

from collections import deque
from collections.abc import Callable, Collection, Iterator

import onnx_ir as ir

from me2e_compress.graph import input_at
from me2e_compress.graph.shapes import is_one_matrix
from me2e_compress.operators import position_inputs, score_inputs
from me2e_compress.quantization.find_attention import behind
from me2e_compress.quantization.geometry import depth, is_few

_POSITIONS: dict[str, tuple[int, ...]] = {
    "DeformConv": (2,),
    **dict.fromkeys(("Gather", "GatherElements", "GatherND", "GridSample"), (1,)),
    **dict.fromkeys(("ScatterElements", "ScatterND"), (1,)),
}
"""Which inputs of standard operators say where to look."""

_ARITHMETIC = frozenset(
    {
        "Abs", "Add", "Cast", "Ceil", "Clip", "Concat", "Cos", "Div", "Dropout", "Exp",
        "Expand", "Flatten", "Floor", "Gather", "GatherElements", "GatherND",
        "Identity", "Log", "Max", "Min", "Mod", "Mul", "Neg", "Pad", "Pow",
        "Reciprocal", "Reshape", "Round", "Sigmoid", "Sin", "Slice", "Split", "Sqrt",
        "Squeeze", "Sub", "Tanh", "Tile", "Transpose", "Unsqueeze", "Where",
    }
)  # fmt: skip
"""What positions are computed with, after the last layer that gave them."""

_LAYOUT = frozenset(
    {
        "Add", "Cast", "Identity", "Reshape", "Slice", "Split", "Squeeze", "Transpose",
        "Unsqueeze",
    }
)  # fmt: skip

_LAYERS = ("Conv", "ConvTranspose", "Einsum", "Gemm", "MatMul")
_DATA_ONLY = {"Gather": 1, "GatherElements": 1, "GatherND": 1, "Pad": 1, "Slice": 1}
"""How many leading inputs hold data: the others are indices, looked at on their own."""


def find_coordinates(
    model: ir.Model, constants: Collection[ir.Value]
) -> dict[ir.Node, str]:
    """Map every layer that produces positions to the reason.

    From whatever takes positions (samplers, gathers, rotations) one walk goes back
    through arithmetic and changes of layout to the layers that they come from: sampling
    offsets, reference points, refinements of boxes; and on through products that sum
    over 4 numbers at most, which turn and shift points. It enters no node twice, so it
    is linear in the graph. Sampling weights whose layer reads the same tensor as such a
    layer are mapped too. ``constants`` are values that no input changes.
    """
    found = {
        node: f"positions that {reader} reads come from it"
        for node, reader in _behind_positions(
            model.graph, lambda layer: is_few(depth(layer)), constants
        )
        if node.op_type in _LAYERS
    }
    return {**found, **_companions(model, found, constants)}


def position_arithmetic(
    model: ir.Model, constants: Collection[ir.Value]
) -> frozenset[ir.Node]:
    """Find the nodes that compute positions, and the layers they come from.

    The same walk as :func:`find_coordinates`; it ends at layers with a weight, and goes
    on through other products, which are projections: of two computed operands, or of a
    camera's matrix and a table of points.
    """
    behind_positions = _behind_positions(
        model.graph, lambda layer: not _has_weight(layer, constants)
    )
    return frozenset(
        node
        for node, _ in behind_positions
        if node.op_type in _ARITHMETIC or node.op_type in _LAYERS
    )


def _behind_positions(
    graph: ir.Graph,
    goes_through: Callable[[ir.Node], bool],
    known: Collection[ir.Value] = (),
) -> Iterator[tuple[ir.Node, str]]:
    """Walk back from the readers of positions; yield each node once, and its reader.

    The walk goes on through arithmetic, and through the layers that the test names; it
    ends at ``known`` values.
    """
    queue = deque(_positions(graph))
    seen: set[ir.Node] = set()
    while queue:
        value, reader = queue.popleft()
        node = value.producer()
        if node is None or node in seen or value in known:
            continue
        seen.add(node)
        yield node, reader
        # Indices and bounds are looked at on their own
        if node.op_type in _ARITHMETIC:
            data = node.inputs[: _DATA_ONLY.get(node.op_type, len(node.inputs))]
        elif node.op_type in _LAYERS and goes_through(node):
            data = node.inputs
        else:
            continue
        queue.extend((each, reader) for each in data if each is not None)


def _has_weight(layer: ir.Node, constants: Collection[ir.Value]) -> bool:
    """Return whether a layer multiplies every row by one constant matrix."""
    if layer.op_type == "MatMul" and not is_one_matrix(layer):
        return False
    return len(layer.inputs) > 1 and layer.inputs[1] in constants


def _positions(graph: ir.Graph) -> Iterator[tuple[ir.Value, str]]:
    known = {**position_inputs(), **_POSITIONS}
    for node in graph:
        for index in known.get(node.op_type, ()):
            value = input_at(node, index)
            if value is not None:
                yield value, node.op_type


def _companions(
    model: ir.Model, found: dict[ir.Node, str], constants: Collection[ir.Value]
) -> dict[ir.Node, str]:
    """Find layers of sampling weights beside layers of offsets."""
    shared = {node.inputs[0] for node in found}

    def is_beside(node: ir.Node) -> bool:
        return (
            node.op_type in _LAYERS
            and node not in found
            and node.inputs[0] in shared
            and node.inputs[1] in constants
        )

    # layers behind every tensor of sampling weights
    nearest = behind(model.graph, _LAYOUT, is_beside)
    reason = "sampling weights: they read the tensor that the offsets read"
    return {
        node: reason
        for value in _weights(model.graph)
        for _, node in nearest.get(value, ())
    }


def _weights(graph: ir.Graph) -> Iterator[ir.Value]:
    scores = {**score_inputs(), "Softmax": 0}
    for node in graph:
        index = scores.get(node.op_type)
        value = None if index is None else node.inputs[index]
        if value is not None:
            yield value
