"""Fuse what exporters decompose into ONNX's operators: activations, normalization.

Given:   x * 0.5 * (1 + Erf(x / sqrt 2));
         d = x - ReduceMean(x);  d / Sqrt(ReduceMean(d * d) + eps) * scale + bias
Result:  Gelu(x);  LayerNormalization(x, scale, bias)

Gelu: Hendrycks, Gimpel 2016 (erf and tanh forms). HardSwish: Howard et al. 2019.
LayerNormalization: Ba, Kiros, Hinton 2016. Mish: Misra 2019. Swish: Ramachandran et al.
2017.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, rank_of, static_shape
from me2e_compress.graph.nodes import (
    Array,
    integers_at,
    is_close,
    scalar_of,
    sole_reader,
)
from me2e_compress.graph.rewrite import (
    Facts,
    Fusion,
    Kit,
    Match,
    Pattern,
    constant,
    either,
    needs_opset,
    op,
    product,
    var,
)
from me2e_compress.graph.runtime_operators import has_operator

SINCE = {
    "Gelu": 20, "HardSwish": 14, "LayerNormalization": 17, "Mish": 18, "Swish": 24
}  # fmt: skip
"""The opset that brought each operator."""

TANH_CUBE = 0.044715
"""The cubic term of the tanh form of Gelu."""

TANH_ROOT = math.sqrt(2 / math.pi)
"""The factor before the bracket of that form."""

CLIP_SINCE = 12
"""The opset from which Clip takes its bounds as inputs, for all types."""

LAYERS = frozenset(
    {"Conv", "ConvTranspose", "Einsum", "Gemm", "LayerNormalization", "Softmax"}
)
"""Operators that mix a value with others, after which its last digits do not matter."""

KINDS = (ir.DataType.FLOAT, ir.DataType.FLOAT16)

X = var("x")
ONE = constant(1.0)
RELU6_PLUS_3 = op("Clip", op("Add", X, constant(3.0)), constant(0.0), constant(6.0))

ERF = op("Erf", product(X, scale=1 / math.sqrt(2)))
TANH = op(
    "Tanh",
    either(
        product(op("Add", X, product(X, X, X, scale=TANH_CUBE)), scale=TANH_ROOT),
        product(X, op("Add", product(X, X, scale=TANH_CUBE), ONE), scale=TANH_ROOT),
    ),
)


LOW, HIGH = (constant(scalar=True, floating=False) for _ in range(2))
"""The bounds of a Clip, of whatever type."""


def fusions(*, swish: bool) -> tuple[Fusion, ...]:
    """Build the fusions; Swish is refused unless allowed."""
    exponential = op("Add", op("Exp", op("Neg", X)), ONE)
    sigmoid = either(op("Div", ONE, exponential), op("Reciprocal", exponential))
    swish_opset = needs_opset("Swish", SINCE["Swish"])

    def swish_check(match: Match, facts: Facts) -> str | None:
        if reason := swish_opset(match, facts):
            return reason
        if not swish:
            return "Swish, for which onnxruntime has no kernel"
        if not has_operator("Swish", facts.opset):
            return f"onnxruntime has no Swish in opset {facts.opset}"
        return None

    gated, sixth = op("HardSigmoid", X, where=_is_sixth), 1 / 6
    tanh, gate = {"approximate": "tanh"}, {"alpha": sixth, "beta": 0.5}
    return (
        _fusion("Gelu", product(X, op("Add", ERF, ONE), scale=0.5)),
        _fusion("Gelu", product(X, op("Add", TANH, ONE), scale=0.5), tanh),
        _fusion("Swish", product(X, op("Sigmoid", X)), check=swish_check),
        _fusion("Mish", product(X, op("Tanh", op("Softplus", X)))),
        _fusion("HardSwish", product(X, gated)),
        _fusion("HardSwish", product(X, RELU6_PLUS_3, scale=sixth)),
        _fusion(
            "HardSigmoid", product(RELU6_PLUS_3, scale=sixth), gate, where=_stands_alone
        ),
        _fusion("Sigmoid", sigmoid, name="Sigmoid", check=_stays_a_part),
        # without the overflow of the Exp
        _fusion("Softplus", op("Log", op("Add", op("Exp", X), ONE)), name="Softplus"),
        Fusion(
            "Clip",
            either(
                op("Min", either(op("Max", X, LOW), op("Relu", X)), HIGH),
                op("Max", op("Min", X, HIGH), LOW),
            ),
            _put_clip,
            needs_opset("Clip of all types", CLIP_SINCE),
            _is_interval,
        ),
    )


def _fusion(
    op_type: str,
    pattern: Pattern,
    attributes: Mapping[str, float | str] | None = None,
    *,
    name: str = "activations",
    check: Callable[[Match, Facts], str | None] | None = None,
    where: Callable[[Match, Facts], bool] | None = None,
) -> Fusion:
    """Build the fusion of an expression of x into an operator that the opset has."""
    if check is None and op_type in SINCE:
        check = needs_opset(op_type, SINCE[op_type])

    def put(match: Match, kit: Kit) -> None:
        kit.put(op_type, [match[X]], attributes)

    return Fusion(name, pattern, put, check, where or _is_float)


def _stays_a_part(match: Match, facts: Facts) -> str | None:
    """Refuse a sigmoid whose Log follows before any layer: an inverse sigmoid.

    onnxruntime's Sigmoid is exact to 8e-8; near 1e-5, where detectors clip inverse
    sigmoids, that moves the logit by 8e-3.
    """
    ahead, seen = deque(match.root.outputs), set(match.root.outputs)
    while ahead:
        # Search forward up to the next layers
        for reader in ahead.popleft().consumers():
            if reader.op_type == "Log":
                return "Sigmoid that a Log turns back: only written out it is exact"
            by_weights = reader.op_type == "MatMul" and any(
                array_of(value) is not None for value in reader.inputs
            )
            if not by_weights and reader.op_type not in LAYERS:
                ahead.extend(value for value in reader.outputs if value not in seen)
                seen.update(reader.outputs)
    return None


def _is_float(match: Match, facts: Facts) -> bool:
    return match.root.outputs[0].dtype in KINDS and _keeps_rank(match)


def _keeps_rank(match: Match) -> bool:
    """Return whether no constant has more axes than x."""
    rank = rank_of(match[X])
    return rank is not None and rank == rank_of(match.root.outputs[0])


def _stands_alone(match: Match, facts: Facts) -> bool:
    """Leave a HardSigmoid to HardSwish where the product with x follows."""
    reader = sole_reader(match.root.outputs[0])
    gates = reader is not None and match[X] in reader.inputs
    return _is_float(match, facts) and not gates


def _is_sixth(node: ir.Node) -> bool:
    alpha = node.attributes.get_float("alpha", 0.2)
    beta = node.attributes.get_float("beta", 0.5)
    return is_close(alpha, 1 / 6) and is_close(beta, 0.5)


def _bounds(match: Match) -> list[Array]:
    high = match.array(HIGH).reshape(())
    if LOW not in match:  # a Relu
        return [np.zeros((), high.dtype), high]
    return [match.array(LOW).reshape(()), high]


def _is_interval(match: Match, facts: Facts) -> bool:
    low, high = _bounds(match)
    return _keeps_rank(match) and bool(np.less_equal(low, high))


def _put_clip(match: Match, kit: Kit) -> None:
    name = match.root.outputs[0].name
    limits = [
        kit.constant(bound, f"{name}_{which}")
        for which, bound in zip(("min", "max"), _bounds(match), strict=True)
    ]
    kit.put("Clip", [match[X], *limits])


# Layer normalization.

EPSILON = constant(scalar=True)
# exporters write x - mean once or twice, and others may read either
MEANS = tuple(op("ReduceMean", X, more=True, shared=True) for _ in range(2))
CENTRED, AGAIN = (op("Sub", X, mean, shared=True) for mean in MEANS)
SQUARE = either(
    op("Mul", AGAIN, AGAIN),
    op("Pow", AGAIN, constant(), where=lambda node: scalar_of(node.inputs[1]) == 2.0),
)
VARIANCE = op("ReduceMean", SQUARE, more=True)
NORMALIZED = op("Div", CENTRED, op("Sqrt", op("Add", VARIANCE, EPSILON)))


def _is_over_last_axes(match: Match, facts: Facts) -> bool:
    """Return whether all three means are over the same last axes."""
    rank = rank_of(match[X]) or 0
    first, *others = [_axes(match.node(mean)) for mean in (VARIANCE, *MEANS)]
    if not rank or not first or others != [first, first]:
        return False
    if rank_of(match.root.outputs[0]) != rank:
        return False  # the epsilon has more axes
    # The axes must be the last ones
    last = list(range(rank - len(first), rank))
    return sorted(axis % rank for axis in first) == last


def _axes(node: ir.Node) -> list[int] | None:
    if not node.attributes.get_int("keepdims", 1):
        return None
    return integers_at(node, "axes", 1)


def _check_normal(match: Match, facts: Facts) -> str | None:
    since = SINCE["LayerNormalization"]
    if facts.opset < since:
        return f"LayerNormalization needs opset {since}"
    if static_shape(match[X]) is None or match[X].dtype not in KINDS:
        return "LayerNormalization of an unknown shape or of float64"
    return None


def _put_normal(match: Match, kit: Kit) -> None:
    source, root = match[X], match.root
    shape, axes = static_shape(source) or (), _axes(match.node(VARIANCE)) or []
    normal = shape[len(shape) - len(axes) :]
    # Take in the scale and bias that follow
    multiplied, scale = _following(root, "Mul", normal)
    end = root if multiplied is None else multiplied
    added, bias = _following(end, "Add", normal)
    epsilon = match.array(EPSILON)
    if scale is None:
        ones = np.ones(normal, epsilon.dtype)
        scale = kit.constant(ones, f"{root.outputs[0].name}_scale")
    kit.put(
        "LayerNormalization",
        [source, scale, *([] if bias is None else [bias])],
        {"axis": -len(axes), "epsilon": float(epsilon.item())},
        behind=[node for node in (multiplied, added) if node is not None],
    )


def _following(
    node: ir.Node, op_type: str, shape: tuple[int, ...]
) -> tuple[ir.Node | None, ir.Value | None]:
    """Return the Mul (or Add) that scales (or shifts) a result, and its constant."""
    reader = sole_reader(node.outputs[0])
    if reader is None or reader.op_type != op_type or reader.graph is not node.graph:
        return None, None
    for value in reader.inputs:
        array = array_of(value)
        if array is not None and array.shape == shape:
            return reader, value
    return None, None


LAYER_NORM = Fusion(
    "layer normalizations", NORMALIZED, _put_normal, _check_normal, _is_over_last_axes
)
