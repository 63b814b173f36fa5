"""Fuse decomposed activations into ONNX's operators.

Given:   x * 0.5 * (1 + Erf(x / sqrt 2))
Result:  Gelu(x)

Gelu: Hendrycks, Gimpel 2016 (erf and tanh forms). HardSwish: Howard et al. 2019.
Mish: Misra 2019. Swish: Ramachandran et al. 2017.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, rank_of
from me2e_compress.graph.rewrite import (
    Array,
    Facts,
    Fusion,
    Kit,
    Match,
    Pattern,
    constant,
    either,
    is_close,
    needs_opset,
    op,
    product,
    sole_reader,
    var,
)

SINCE = {"Gelu": 20, "HardSwish": 14, "Mish": 18, "Swish": 24}
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

RELU = op("Relu", X)


def fusions(*, swish: bool) -> tuple[Fusion, ...]:
    """Build the fusions; Swish is refused unless allowed."""
    gelu = product(X, op("Add", ERF, ONE), scale=0.5)
    tanh_gelu = product(X, op("Add", TANH, ONE), scale=0.5)
    gated = product(X, op("HardSigmoid", X, where=_is_sixth))
    return (
        _named("Gelu", gelu),
        _named("Gelu", tanh_gelu, {"approximate": "tanh"}),
        _swish(allowed=swish),
        _named("Mish", product(X, op("Tanh", op("Softplus", X)))),
        _named("HardSwish", gated),
        _named("HardSwish", product(X, RELU6_PLUS_3, scale=1 / 6)),
        _hard_sigmoid(),
        _sigmoid(),
        # without the overflow of the Exp
        _simple("Softplus", op("Log", op("Add", op("Exp", X), ONE))),
        _clip(),
    )


def _named(
    op_type: str, pattern: Pattern, attributes: Mapping[str, str] | None = None
) -> Fusion:
    return Fusion(
        "activations",
        pattern,
        lambda match, kit: kit.put(op_type, [match[X]], attributes),
        needs_opset(op_type, SINCE[op_type]),
        _is_float,
    )


def _simple(op_type: str, pattern: Pattern) -> Fusion:
    return Fusion(
        op_type,
        pattern,
        lambda match, kit: kit.put(op_type, [match[X]]),
        where=_is_float,
    )


def _sigmoid() -> Fusion:
    exponential = op("Add", op("Exp", op("Neg", X)), ONE)
    spelled = either(op("Div", ONE, exponential), op("Reciprocal", exponential))
    return dataclasses.replace(_simple("Sigmoid", spelled), check=_stays_a_part)


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
            if not _is_layer(reader):
                ahead.extend(value for value in reader.outputs if value not in seen)
                seen.update(reader.outputs)
    return None


def _is_layer(node: ir.Node) -> bool:
    by_weights = node.op_type == "MatMul" and any(
        array_of(value) is not None for value in node.inputs
    )
    return by_weights or node.op_type in LAYERS


def _is_float(match: Match, facts: Facts) -> bool:
    return match.root.outputs[0].dtype in KINDS and _keeps_rank(match)


def _keeps_rank(match: Match) -> bool:
    """Return whether no constant has more axes than x."""
    rank = rank_of(match[X])
    return rank is not None and rank == rank_of(match.root.outputs[0])


def _swish(*, allowed: bool) -> Fusion:
    known = needs_opset("Swish", SINCE["Swish"])

    def check(match: Match, facts: Facts) -> str | None:
        reason = known(match, facts)
        if reason is None and not allowed:
            return "Swish, for which onnxruntime has no kernel"
        return reason

    named = _named("Swish", product(X, op("Sigmoid", X)))
    return dataclasses.replace(named, check=check)


def _is_sixth(node: ir.Node) -> bool:
    alpha = node.attributes.get_float("alpha", 0.2)
    beta = node.attributes.get_float("beta", 0.5)
    return is_close(alpha, 1 / 6) and is_close(beta, 0.5)


def _hard_sigmoid() -> Fusion:
    def stands_alone(match: Match, facts: Facts) -> bool:
        """Leave it to HardSwish where the product with x follows."""
        reader = sole_reader(match.root.outputs[0])
        gates = reader is not None and match[X] in reader.inputs
        return _is_float(match, facts) and not gates

    return Fusion(
        "activations",
        product(RELU6_PLUS_3, scale=1 / 6),
        lambda match, kit: kit.put(
            "HardSigmoid", [match[X]], {"alpha": 1 / 6, "beta": 0.5}
        ),
        where=stands_alone,
    )


def _clip() -> Fusion:
    raised = either(op("Max", X, LOW), RELU)
    return Fusion(
        "Clip",
        either(op("Min", raised, HIGH), op("Max", op("Min", X, HIGH), LOW)),
        _put_clip,
        needs_opset("Clip of all types", CLIP_SINCE),
        _is_interval,
    )


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
