"""Decomposed activations that ONNX has a name for.

Given:   x * 0.5 * (1 + Erf(x / sqrt 2))
Result:  Gelu(x)

Gelu: Hendrycks, Gimpel 2016 (erf and tanh forms). HardSwish: Howard et al. 2019.
Mish: Misra 2019. Swish: Ramachandran et al. 2017.
"""

import math

import onnx_ir as ir

from me2e_compress.passes.fuse_basic.match import (
    Site,
    is_close,
    maker,
    plus_scalar,
    scalar_of,
    sole_maker,
)
from me2e_compress.passes.fuse_basic.products import Product, product_of, scaled
from me2e_compress.rewrite import put, sole_reader

SINCE = {"Gelu": 20, "HardSwish": 14, "Mish": 18, "Swish": 24}
"""The opset that brought each operator."""

TANH_CUBE = 0.044715
"""The cubic term of the tanh form of Gelu."""

KINDS = (ir.DataType.FLOAT, ir.DataType.FLOAT16)


def fuse_activation(node: ir.Node, site: Site) -> bool:
    """Fuse a product that is an activation, ending in this Mul or Div."""
    if node.op_type not in ("Mul", "Div") or node.outputs[0].dtype not in KINDS:
        return False
    product = product_of(node)
    if len(product.factors) == 1:
        return _hard_sigmoid(node, product, site)
    if len(product.factors) != 2:
        return False
    for source, gate in (product.factors, product.factors[::-1]):
        found = _name(source, gate, product.scale)
        if found is not None and sole_reader(gate) is not None:
            return _replace(node, source, found, product, site)
    return False


def _name(
    source: ir.Value, gate: ir.Value, scale: float
) -> tuple[str, dict[str, str]] | None:
    """Name the activation that is ``scale * source * gate``."""
    if is_close(scale, 0.5):
        inner = plus_scalar(gate, 1.0)
        if _is_erf(inner, source):
            return "Gelu", {}
        if _is_tanh(inner, source):
            return "Gelu", {"approximate": "tanh"}
    if is_close(scale, 1.0):
        for op_type, test in (
            ("Swish", _is_sigmoid),
            ("Mish", _is_tanh_softplus),
            ("HardSwish", _is_hard_sigmoid),
        ):
            if test(gate, source):
                return op_type, {}
    if is_close(scale, 1 / 6) and _is_relu6_plus_3(gate, source):
        return "HardSwish", {}
    return None


def _replace(
    node: ir.Node,
    source: ir.Value,
    found: tuple[str, dict[str, str]],
    product: Product,
    site: Site,
) -> bool:
    op_type, attributes = found
    if site.opset < SINCE[op_type]:
        return site.refuse(f"{op_type} needs opset {SINCE[op_type]}")
    if op_type == "Swish" and not site.swish:
        return site.refuse("Swish, for which onnxruntime has no kernel")
    put(
        node,
        op_type,
        [source],
        by=site.by,
        sources=product.nodes[1:],
        attributes=dict(attributes),
    )
    return True


def _is_erf(value: ir.Value | None, source: ir.Value) -> bool:
    node = sole_maker(value, "Erf")
    parts = scaled(node.inputs[0]) if node is not None else None
    return (
        parts is not None
        and parts[1] is source
        and is_close(parts[0], 1 / math.sqrt(2))
    )


def _is_tanh(value: ir.Value | None, source: ir.Value) -> bool:
    node = sole_maker(value, "Tanh")
    outer = sole_maker(node.inputs[0], "Mul") if node is not None else None
    if outer is None:
        return False
    product = product_of(outer)
    if not is_close(product.scale, math.sqrt(2 / math.pi)):
        return False
    if len(product.factors) == 1:
        return _is_cubic(product.factors[0], source)
    return (
        len(product.factors) == 2
        and source in product.factors
        and any(_is_one_plus_square(factor, source) for factor in product.factors)
    )


def _is_cubic(value: ir.Value, source: ir.Value) -> bool:
    """``x + 0.044715 x^3``."""
    node = sole_maker(value, "Add")
    if node is None or source not in node.inputs:
        return False
    other = node.inputs[1] if node.inputs[0] is source else node.inputs[0]
    return _is_power(other, source, 3)


def _is_one_plus_square(value: ir.Value, source: ir.Value) -> bool:
    """``1 + 0.044715 x^2``."""
    return _is_power(plus_scalar(value, 1.0), source, 2)


def _is_power(value: ir.Value | None, source: ir.Value, power: int) -> bool:
    node = sole_maker(value, "Mul")
    if node is None:
        return False
    product = product_of(node)
    return is_close(product.scale, TANH_CUBE) and product.factors == [source] * power


def _is_sigmoid(gate: ir.Value, source: ir.Value) -> bool:
    node = maker(gate, "Sigmoid")
    return node is not None and node.inputs[0] is source


def _is_tanh_softplus(gate: ir.Value, source: ir.Value) -> bool:
    node = maker(gate, "Tanh")
    inner = sole_maker(node.inputs[0], "Softplus") if node is not None else None
    return inner is not None and inner.inputs[0] is source


def _is_hard_sigmoid(gate: ir.Value, source: ir.Value) -> bool:
    node = maker(gate, "HardSigmoid")
    return (
        node is not None
        and node.inputs[0] is source
        and is_close(node.attributes.get_float("alpha", 0.2), 1 / 6)
        and is_close(node.attributes.get_float("beta", 0.5), 0.5)
    )


def _is_relu6_plus_3(gate: ir.Value, source: ir.Value | None) -> ir.Value | None:
    """Give x where a value is ``Clip(x + 3, 0, 6)`` (of this source, if named)."""
    node = maker(gate, "Clip")
    if node is None or len(node.inputs) < 3:
        return None
    inner = plus_scalar(node.inputs[0], 3.0)
    if scalar_of(node.inputs[1]) != 0.0 or not is_close(scalar_of(node.inputs[2]), 6.0):
        return None
    return inner if source is None or inner is source else None


def _hard_sigmoid(node: ir.Node, product: Product, site: Site) -> bool:
    gate = product.factors[0]
    if not is_close(product.scale, 1 / 6) or sole_reader(gate) is None:
        return False
    source = _is_relu6_plus_3(gate, None)
    reader = sole_reader(node.outputs[0])
    if source is None or (reader is not None and source in reader.inputs):
        return False
    put(
        node,
        "HardSigmoid",
        [source],
        by=site.by,
        sources=product.nodes[1:],
        attributes={"alpha": 1 / 6, "beta": 0.5},
    )
    return True


def fuse_sigmoid(node: ir.Node, site: Site) -> bool:
    """``1 / (1 + Exp(-x))`` is Sigmoid."""
    if node.op_type == "Div":
        below = node.inputs[1] if is_close(scalar_of(node.inputs[0]), 1.0) else None
    else:
        below = node.inputs[0] if node.op_type == "Reciprocal" else None
    exponential = sole_maker(plus_scalar(below, 1.0), "Exp")
    negated = sole_maker(exponential.inputs[0], "Neg") if exponential else None
    if exponential is None or negated is None or node.outputs[0].dtype not in KINDS:
        return False
    put(node, "Sigmoid", negated.inputs[:1], by=site.by, sources=[exponential, negated])
    return True


def fuse_softplus(node: ir.Node, site: Site) -> bool:
    """``Log(1 + Exp(x))`` is Softplus, which does not overflow."""
    if node.op_type != "Log" or node.outputs[0].dtype not in KINDS:
        return False
    exponential = sole_maker(plus_scalar(node.inputs[0], 1.0), "Exp")
    if exponential is None:
        return False
    put(node, "Softplus", exponential.inputs[:1], by=site.by, sources=[exponential])
    return True
