"""What nothing reads goes at once, and hides nothing from who looks for readers."""

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import GraphError
from me2e_compress.graph import rewrite
from me2e_compress.graph.rewrite import Fusion, fuse, op, var
from me2e_compress.passes.base import Pass
from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, ops, read
from tests.support.profiles import scaled

NESTED = """
g (float[2] x, bool seen) => (float[2] y) <float[2] w = {1, 2}> {
    y = Relu(x)
    a = Neg(x)
    b = Add(a, w)
    dead = If (seen) <
        then_branch = t () => (float[2] t) {
            c = Abs(b)
            t = If (seen) <then_branch = u () => (float[2] u) { u = Mul(a, c) },
                           else_branch = v () => (float[2] v) { v = Neg(w) }>
        },
        else_branch = e () => (float[2] e) { e = Neg(b) }
    >
}
"""


def test_what_a_dead_body_read_is_dead_and_what_is_read_is_not() -> None:
    model = read(NESTED)

    with pytest.raises(GraphError, match="cannot be removed: a is read"):
        rewrite.remove_node(model.graph[1])
    assert rewrite.remove_dead(model.graph) == 3
    assert ops(model) == ["Relu"]
    assert not model.graph.initializers
    assert rewrite.remove_dead(model.graph) == 0


def test_a_branch_in_place_of_its_if_knows_its_shapes_and_the_other_is_gone() -> None:
    text = """
    g (float[4] x) => (float[2,2] y) <bool yes = {1}, int64[2] two = {2, 2}> {
        n = Neg(x)
        a = Reshape(x, two)
        y = If (yes) <then_branch = t () => (float[2,2] t) {
                          b = Reshape(a, two) t = Relu(b)
                      },
                      else_branch = e () => (float[2,2] e) { e = Reshape(n, two) }>
    }"""

    taken = apply(FoldConstants(), read(text)).model
    assert ops(taken) == ["Reshape", "Reshape", "Relu"]
    assert ops(apply(EliminateRedundant(), taken).model) == ["Reshape", "Relu"]


X, Y = var("x"), var("y")
TWICE = op("Relu", op("Relu", X))
ONCE = Fusion("Relu of Relu", TWICE, lambda m, kit: kit.replace_by("Relu", [m[X]]))
DROP = Fusion("Mul", op("Mul", X, Y), lambda m, kit: kit.replace_by("Abs", [m[X]]))


def test_a_dead_reader_hides_no_pattern() -> None:
    text = "g (float[2] x) => (float[2] y) { a = Relu(x) y = Relu(a) dead = Neg(a) }"
    model = read(text)

    result = fuse(model, [ONCE], by="test")

    assert ops(model) == ["Relu"]
    assert result.notes() == ("fused: Relu of Relu (1)", "removed: 1 unread")
    assert fuse(model, [ONCE], by="test").changes == 0


def test_what_a_fusion_in_a_body_frees_is_fused_too() -> None:
    model = read(
        """
        g (float[2] x, bool seen) => (float[2] y) {
            a = Relu(x)
            b = Relu(a)
            n = Neg(a)
            y = If (seen) <then_branch = t () => (float[2] t) { t = Mul(b, n) },
                           else_branch = e () => (float[2] e) { e = Neg(b) }>
        }"""
    )

    result = fuse(model, [ONCE, DROP], by="test")

    assert ops(model) == ["Relu", "If"]
    assert (result.changes, fuse(model, [ONCE, DROP], by="test").changes) == (2, 0)


FORMS = ("Relu({})", "Neg({})", "Identity({})", "Transpose({})", "Add({}, {})",
         "Mul({}, w)", "Add({}, w)", "MatMul({}, w)", "If")  # fmt: skip


def drawn_nodes(draw: st.DrawFn, known: list[str], made: str, depth: int) -> str:
    """Draw nodes that read what is known, bodies too; the last one makes ``made``."""
    text = ""
    for index in reversed(range(draw(st.integers(1, 5)))):
        name = f"{made}{index}" if index else made
        form = draw(st.sampled_from(FORMS[: len(FORMS) - depth // 2]))
        if form == "If":
            given_ = draw(st.sampled_from(["yes", "seen"]))
            bodies = ", ".join(
                f"{branch}_branch = {branch} () => (float[2,2] {name}{branch}) {{"
                f" {drawn_nodes(draw, list(known), name + branch, depth + 1)} }}"
                for branch in ("then", "else")
            )
            text += f"{name} = If ({given_}) <{bodies}>\n"
        else:
            one, two = (draw(st.sampled_from(known)) for _ in range(2))
            text += f"{name} = {form.format(one, two)}\n"
        known.append(name)
    return text


@st.composite
def models(draw: st.DrawFn) -> ir.Model:
    """Draw a graph of which much is dead, with bodies in bodies."""
    weight = np.array([[1, 2], [3, 4]], np.float32)
    text = drawn_nodes(draw, ["x"], "y", 0)
    text = f"g (float[2,2] x, bool seen) => (float[2,2] y) {{\n{text}}}"
    return read(text, w=weight, yes=np.array(True))


@pytest.mark.parametrize("current", [EliminateRedundant(), FuseBasic()])
@settings(max_examples=scaled(40))
@given(model=models())
def test_a_second_run_changes_nothing(current: Pass, model: ir.Model) -> None:
    apply(current, model)  # which runs it twice
