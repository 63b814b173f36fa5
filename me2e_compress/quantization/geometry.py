"""Find the products that carry geometry: camera matrices, points, pixels."""

import dataclasses
import math
import re
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

import onnx_ir as ir

from me2e_compress.graph import input_at, is_standard
from me2e_compress.graph.shapes import extent, is_one_matrix, open_shape
from me2e_compress.operators import op_types, position_inputs, score_inputs
from me2e_compress.quantization.find_attention import behind

MATRICES = frozenset({(3, 3), (3, 4), (4, 4)})
"""Sizes of rotations, camera intrinsics, projections and rigid transforms."""

MOST_MATRICES = 64
"""In one input: cameras times frames. An input of more is a feature map."""

# Numbers that say a point: homogeneous coordinates in space.
WIDEST = 4

# What the inputs of driving stacks call matrices, poses and reference points, for
# those whose shape is not known: lidar2img, ego_pose, l2g_r_mat, ref_pts.
_NAMED = re.compile(
    r"2(img|image|cam|camera|ego|lidar|global|world)(?![a-z])"
    r"|(ego|cam|camera|lidar|sensor)_?pose|intrinsic|extrinsic|projection_mat"
    r"|l2g_|ref(erence)?_(pts|points)",
    re.IGNORECASE,
)

# What positions are computed with, after the last layer that gave them.
_POSITION_ARITHMETIC = frozenset(
    {
        "Abs", "Add", "Cast", "Ceil", "Clip", "Concat", "Cos", "Div", "Dropout", "Exp",
        "Expand", "Flatten", "Floor", "Gather", "GatherElements", "GatherND",
        "Identity", "Log", "Max", "Min", "Mod", "Mul", "Neg", "Pad", "Pow",
        "Reciprocal", "Reshape", "Round", "Sigmoid", "Sin", "Slice", "Split", "Sqrt",
        "Squeeze", "Sub", "Tanh", "Tile", "Transpose", "Unsqueeze", "Where",
    }
)  # fmt: skip

# What points stay points through, besides the inverse of a matrix: no product, no
# comparison, no sine or cosine (an embedding, as fine as its 8 bits), no softmax, no
# sampler.
_ARITHMETIC = _POSITION_ARITHMETIC - {"Cos", "Sin"} | {
    "BatchNormalization", "InstanceNormalization", "LayerNormalization", "ReduceL2",
    "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum", "Relu", "ScatterElements",
    "ScatterND",
}  # fmt: skip

# Inputs that hold data: the others are shapes, indices, bounds and conditions.
_DATA: Mapping[str, tuple[int, ...]] = {
    "BatchNormalization": (0,), "Clip": (0,), "Expand": (0,), "Gather": (0,),
    "GatherElements": (0,), "GatherND": (0,), "InstanceNormalization": (0,),
    "LayerNormalization": (0,), "Pad": (0,), "ReduceL2": (0,), "ReduceMax": (0,),
    "ReduceMean": (0,), "ReduceMin": (0,), "ReduceSum": (0,), "Reshape": (0,),
    "ScatterElements": (0, 2), "ScatterND": (0, 2), "Slice": (0,), "Split": (0,),
    "Squeeze": (0,), "Tile": (0,), "Unsqueeze": (0,), "Where": (1, 2),
}  # fmt: skip

_PRODUCTS = ("Conv", "ConvTranspose", "Einsum", "Gemm", "MatMul")


@dataclasses.dataclass(frozen=True)
class _Source:
    """The input that a value comes from, and whether it is made of matrices alone."""

    name: str
    is_matrix: bool


def find_geometry(
    model: ir.Model, constants: Collection[ir.Value]
) -> dict[ir.Node, str]:
    """Map every product that carries geometry to the input that it comes from.

    Geometry begins at inputs that are matrices (``lidar2img`` [1, 6, 4, 4], poses,
    intrinsics), or are named like matrices and reference points. It continues through
    arithmetic and changes of layout, however the product is batched: a matrix times
    points gives points, be they constant or computed, columns or rows.

    Geometry ends at the first product with a learned weight (more than 4 numbers in or
    out), which reads coordinates and is the last to be mapped; at sines and cosines,
    comparisons and samplers; and where it is added to, or multiplied by, features of
    more than 4 numbers. Layers behind these are layers like any other.

    One sweep over the graph, which is in topological order. ``constants`` are values
    that no input changes.
    """
    walk = _GeometryWalk(constants)
    for value in model.graph.inputs:
        source = _source(value)
        if source is not None and value not in constants:
            walk.sources[value] = source
    for node in model.graph if walk.sources else ():
        walk.enter(node)
    return walk.reasons


class _GeometryWalk:
    """Geometry on its way through a graph.

    ``sources`` are those of the values that are geometry, ``reasons`` the products that
    it went through.
    """

    def __init__(self, constants: Collection[ir.Value]) -> None:
        self.sources: dict[ir.Value, _Source] = {}
        self.reasons: dict[ir.Node, str] = {}
        self._constants = constants
        self._learned: set[ir.Value] = set()
        self._inverses = op_types("inverse")

    def enter(self, node: ir.Node) -> None:
        """Follow geometry, and learned values, through one node."""
        # does the node read geometry, and is its result still geometry
        product = node.op_type in _PRODUCTS and is_standard(node)
        reads: Sequence[ir.Value | None] = node.inputs
        if not product and node.op_type in _DATA:
            reads = [input_at(node, index) for index in _DATA[node.op_type]]
        met = [self.sources[value] for value in reads if value in self.sources]
        shape = open_shape(node.outputs[0])
        goes_on = False
        if met and product:
            self.reasons[node] = f"multiplies what comes from the input {met[0].name}"
            goes_on = self._passes(node)
        elif met and (node.op_type in _ARITHMETIC or node.op_type in self._inverses):
            # arithmetic with learned values: few numbers are still points
            learned = any(value in self._learned for value in reads)
            goes_on = not learned or (
                shape is not None and shape != () and is_few(shape[-1])
            )
        # mark the results as geometry, or else as learned
        if goes_on:
            matrix = all(source.is_matrix for source in met) and all(
                value is None or value in self.sources or value in self._constants
                for value in reads
            )
            if product:
                matrix = matrix and _is_small(node.outputs[0])
            source = _Source(met[0].name, matrix)
            self.sources.update(dict.fromkeys(node.outputs, source))
        elif product or any(value in self._learned for value in node.inputs):
            self._learned.update(node.outputs)

    def _passes(self, product: ir.Node) -> bool:
        """Return whether a product gives points or matrices, not features."""
        left, right = product.inputs[0], product.inputs[1]
        if left in self.sources and right in self.sources:
            return True
        if not is_few(depth(product)):
            return False
        one = left if left in self.sources else right
        if one is not None and one in self.sources and self.sources[one].is_matrix:
            return _is_stacked(one) or _is_small(product.outputs[0])
        # how many numbers for each point; points on the right are columns
        shape = open_shape(product.outputs[0])
        if shape is None or len(shape) < 2:
            return False
        if product.op_type in ("Conv", "ConvTranspose"):
            return is_few(shape[1])
        return is_few(shape[-2] if one is right else shape[-1])


def _source(value: ir.Value) -> _Source | None:
    if value.dtype is not None and not value.dtype.is_floating_point():
        return None
    name, shape = str(value.name), open_shape(value)
    if shape is not None and shape[-2:] in MATRICES:
        many = math.prod(dim for dim in shape[:-2] if dim is not None)
        return _Source(name, True) if many <= MOST_MATRICES else None
    if _NAMED.search(name) is None:
        return None
    return _Source(name, shape is None or shape[-2:].count(None) > 0)


def is_few(size: int | None) -> bool:
    """Return whether so many numbers may be one point's: homogeneous at most."""
    return size is not None and size <= WIDEST


def _is_small(value: ir.Value) -> bool:
    """Return whether a value is a batch of matrices of a few rows and columns."""
    shape = open_shape(value)
    return shape is not None and len(shape) > 1 and all(map(is_few, shape[-2:]))


def _is_stacked(value: ir.Value) -> bool:
    """Return whether a value is a batch of matrices, or matrices one below the other.

    Parts of matrices, say translations [cameras, 3], are not: a weight may follow.
    """
    shape = open_shape(value)
    if shape is None or len(shape) < 2:
        return True
    rows, columns = shape[-2:]
    if is_few(rows) and is_few(columns):
        return columns in (3, 4) and rows in (2, 3, 4)
    return 4 in (rows, columns) and (rows or 0) % 4 == 0 and (columns or 0) % 4 == 0


def depth(product: ir.Node) -> int | None:
    """Return how many numbers a product sums over for each of its results."""
    if product.op_type in ("Gemm", "MatMul"):
        return extent(product, weight=False).depth
    shape = open_shape(product.inputs[1])
    if shape is None or product.op_type == "Einsum":  # imported as a MatMul, if it can
        return None
    return shape[1 if product.op_type == "Conv" else 0]


# Find the layers that produce positions.


# Which inputs of standard operators say where to look.
_POSITIONS: dict[str, tuple[int, ...]] = {
    "DeformConv": (2,),
    **dict.fromkeys(("Gather", "GatherElements", "GatherND", "GridSample"), (1,)),
    **dict.fromkeys(("ScatterElements", "ScatterND"), (1,)),
}

_LAYOUT = frozenset(
    {
        "Add", "Cast", "Identity", "Reshape", "Slice", "Split", "Squeeze", "Transpose",
        "Unsqueeze",
    }
)  # fmt: skip
# How many leading inputs hold data: the others are indices, looked at on their own.
_DATA_ONLY = {"Gather": 1, "GatherElements": 1, "GatherND": 1, "Pad": 1, "Slice": 1}


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
    products = {
        node: f"positions that {reader} reads come from it"
        for node, reader in _behind_positions(
            model.graph, lambda layer: is_few(depth(layer)), constants
        )
        if node.op_type in _PRODUCTS
    }
    return {**products, **_companions(model, products, constants)}


def position_arithmetic(
    model: ir.Model, constants: Collection[ir.Value]
) -> frozenset[ir.Node]:
    """Find the nodes that compute positions, and the layers they come from.

    The same walk as :func:`find_coordinates`; it ends at layers with a weight, and goes
    on through other products, which are projections: of two computed operands, or of a
    camera's matrix and a table of points.
    """
    behind_positions = _behind_positions(
        model.graph,
        # a weight is one constant matrix for every row
        lambda layer: (
            (layer.op_type == "MatMul" and not is_one_matrix(layer))
            or input_at(layer, 1) not in constants
        ),
    )
    return frozenset(
        node
        for node, _ in behind_positions
        if node.op_type in _POSITION_ARITHMETIC or node.op_type in _PRODUCTS
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
    # Start at every operand that says where to look
    positions = {**position_inputs(), **_POSITIONS}
    queue = deque(
        (value, node.op_type)
        for node in graph
        for index in positions.get(node.op_type, ())
        if (value := input_at(node, index)) is not None
    )
    visited: set[ir.Node] = set()
    while queue:
        value, reader = queue.popleft()
        node = value.producer()
        if node is None or node in visited or value in known:
            continue
        visited.add(node)
        yield node, reader
        # Indices and bounds are looked at on their own
        if node.op_type in _POSITION_ARITHMETIC:
            data = node.inputs[: _DATA_ONLY.get(node.op_type, len(node.inputs))]
        elif node.op_type in _PRODUCTS and goes_through(node):
            data = node.inputs
        else:
            continue
        queue.extend((value, reader) for value in data if value is not None)


def _companions(
    model: ir.Model, products: dict[ir.Node, str], constants: Collection[ir.Value]
) -> dict[ir.Node, str]:
    """Find layers of sampling weights beside layers of offsets."""
    # Layers that read the same tensor as a layer of offsets
    shared = {node.inputs[0] for node in products}

    def is_beside(node: ir.Node) -> bool:
        return (
            node.op_type in _PRODUCTS
            and node not in products
            and node.inputs[0] in shared
            and node.inputs[1] in constants
        )

    # layers behind every tensor of sampling weights
    nearest = behind(model.graph, _LAYOUT, is_beside)
    reason = "sampling weights: they read the tensor that the offsets read"
    scores = {**score_inputs(), "Softmax": 0}
    return {
        layer: reason
        for node in model.graph
        if node.op_type in scores
        if (value := node.inputs[scores[node.op_type]]) is not None
        for layer in nearest.get(value, ())
    }
