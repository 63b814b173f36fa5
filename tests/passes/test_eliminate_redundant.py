from typing import Any

import numpy as np
import pytest

from me2e_compress.graph import provenance
from me2e_compress.graph.rewrite import add_constant
from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from tests.passes.small import apply, ops, read


def one(call: str, kind: str = "float[2,3]", out: str = "float[2,3]") -> str:
    """A graph of Relu, the call on ``a``, and Relu."""
    return f"g ({kind} x) => ({out} y) {{ a = Abs(x)  b = {call}  y = Neg(b) }}"


SHAPE = {"s": np.array([2, 3])}
ONE = {"c": np.float32(1)}


@pytest.mark.parametrize(
    ("call", "weights"),
    [
        ("Identity(a)", {}),
        ("Dropout(a)", {}),
        ("Dropout(a, r, t)", {"r": np.float32(0.5), "t": np.bool_(False)}),
        ("Cast<to = 1>(a)", {}),
        ("Reshape(a, s)", SHAPE),
        ("Expand(a, s)", SHAPE),
        ("Tile(a, s)", {"s": np.array([1, 1])}),
        ("Transpose<perm = [0, 1]>(a)", {}),
        ("Flatten(a)", {}),
        ("Concat<axis = 0>(a)", {}),
        ("Max(a)", {}),
        ("Pad(a, s)", {"s": np.zeros(4, np.int64)}),
        ("Slice(a, s, e)", {"s": np.array([0]), "e": np.array([99])}),
        ("Mul(a, c)", ONE),
        ("Mul(c, a)", ONE),
        ("Div(a, c)", ONE),
        ("Where(c, a, a)", {"c": np.eye(2, 3) > 0}),
    ],
)
def test_identities_go(call: str, weights: dict[str, Any]) -> None:
    model = read(one(call), **weights)
    apply(EliminateRedundant(), model)
    assert ops(model) == ["Abs", "Neg"]


@pytest.mark.parametrize(
    ("call", "weights", "why"),
    [
        ("Add(a, c)", {"c": np.float32(0.0)}, "-0.0 + 0.0 is +0.0"),
        ("Sub(a, c)", {"c": np.float32(-0.0)}, "-0.0 - -0.0 is +0.0"),
        ("Sub(c, a)", {"c": np.float32(0.0)}, "a negation"),
        ("Div(c, a)", ONE, "a reciprocal"),
        ("Mul(a, c)", {"c": np.ones((2, 2, 3), np.float32)}, "broadcasts"),
        ("Transpose<perm = [1, 0]>(a)", {}, "moves"),
        ("Dropout(a, r, t)", {"r": np.float32(0.5), "t": np.bool_(True)}, "trains"),
        (
            "Slice(a, s, e, x0, s)",
            {"s": np.array([-1]), "e": np.array([-99]), "x0": np.array([0])},
            "reverses",
        ),
    ],
)
def test_near_identities_stay(call: str, weights: dict[str, Any], why: str) -> None:
    model = read(one(call, out="float[A,B]"), **weights)
    assert apply(EliminateRedundant(), model).changes == 0, why


TWINS = """
g (float[2] x, float[2] z) => (float[2] y) {
    a = Add(x, z)
    b = Add(z, x)
    y = Mul(a, b)
}
"""


DRAWN = TWINS.replace("Add(x, z)", "RandomNormalLike(x)").replace(
    "Add(z, x)", "RandomNormalLike(x)"
)


@pytest.mark.parametrize(
    ("text", "modules", "left"),
    [
        (TWINS, ("det", "det"), 2),
        (TWINS, ("det", "map"), 3),
        (DRAWN, ("det", "det"), 3),
    ],
)
def test_equal_nodes_are_merged(text: str, modules: tuple[str, str], left: int) -> None:
    model = read(text)
    for node, module in zip(model.graph, (*modules, modules[1]), strict=True):
        provenance.stamp(node, provenance.Provenance(module, (node.name or "",)))
    apply(EliminateRedundant(), model)
    assert len(model.graph) == left
    if modules == ("det", "det") and left == 2:
        past = provenance.read(model.graph.node(0))
        by = ("eliminate-redundant",)
        assert past == provenance.Provenance("det", ("n0", "n1"), by)


def test_equal_initializers_become_one_and_idle_ones_go() -> None:
    text = """
    g (float[2] x) => (float[2] y) { a = Add(x, p) b = Mul(a, q) y = Sub(b, r) }
    """
    array = np.array([1, 2], np.float32)
    model = read(text, p=array, q=array, r=array + 1)
    add_constant(model.graph, array, "idle")
    apply(EliminateRedundant(), model)
    assert list(model.graph.initializers) == ["p", "r"]


def test_initializers_that_differ_in_the_middle_stay_apart() -> None:
    text = "g (float[99] x) => (float[99] y) { a = Add(x, p) y = Mul(a, q) }"
    p = np.zeros(99, np.float32)
    q = p.copy()
    q[50] = 1
    model = read(text, p=p, q=q)
    apply(EliminateRedundant(), model)
    assert list(model.graph.initializers) == ["p", "q"]


def test_an_identity_between_input_and_output_stays() -> None:
    model = read("g (float[2] x) => (float[2] y) { y = Identity(x) }")
    assert apply(EliminateRedundant(), model).changes == 0
