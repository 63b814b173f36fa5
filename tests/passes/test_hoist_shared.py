"""Attention over rows that were written for every batch entry, as exporters do it."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.graph import static_shape
from me2e_compress.passes.hoist_linear import HoistLinear
from tests.passes.hoisted import RANDOM, graph_of, hoist, integers, normal, products
from tests.passes.small import apply, compute, ops, read

B, J, H, D = 300, 10, 4, 8
WIDE = H * D
ROWS, KEYS = J - 1, f"{B},{J}"


def repeated(name: str, row: str) -> str:
    """Rows of a map for every batch entry, and a stored row behind them."""
    return (
        f"{name}many = Tile(map, times)  {name}flat = Reshape(map_{name}, flat)"
        f" {name}more = Concat<axis = 1>({name}flat, {row})"
        f" {name} = Transpose<perm = [1, 0, 2]>({name}more)"
    ).replace(f"map_{name}", f"{name}many")


BODY = (
    repeated("lanes", "row")
    + " linear = MatMul(position, p)  wide = Add(linear, c)  keys = Add(lanes, wide)"
    " split = Reshape(keys, heads)  turned = Transpose<perm = [1, 2, 0]>(split)"
    " scaled = Mul(q, scale)  scores = MatMul(scaled, turned)"
    " masked = Add(scores, mask)  shares = Softmax<axis = -1>(masked) "
    + repeated("other", "last")
    + " cut = Reshape(other, heads)  values = Transpose<perm = [1, 0, 2]>(cut)"
    " y = MatMul(shares, values)"
)
SIGNATURE = (
    f"(float[{B * H},1,{D}] q, float[1,1,{ROWS},{WIDE}] map,"
    f" float[{J},{B},2] position, float[{B * H},1,{J}] mask)"
    f" => (float[{B * H},1,{D}] y"
)


def weights() -> dict[str, Any]:
    return {
        "times": integers(1, B, 1, 1),
        "flat": integers(B, ROWS, WIDE),
        "heads": integers(J, B * H, D),
        "row": np.repeat(normal(1, 1, WIDE), B, 0),
        "last": np.repeat(normal(1, 1, WIDE), B, 0),
        "p": normal(2, WIDE), "c": normal(WIDE), "scale": normal(1)[0],
    }  # fmt: skip


def test_keys_that_were_repeated_for_every_batch_entry_are_made_once() -> None:
    """As VAD's motion reads the map: tiled, behind a stored row, merged with heads."""
    model = hoist(graph_of(f"{SIGNATURE})", BODY), **weights())

    sizes = [np.prod(static_shape(node.outputs[0]) or ()) for node in model.graph]
    assert max(sizes) == B * H * max(J, D)
    shared, positions = B * H * J * D, B * H * 2 * (D + J)
    assert products(model) == 2 * shared + positions
    assert not {"Tile", "Expand"} & set(ops(model))


CHANGED = {
    "something else reads them": (BODY + " more = Relu(keys)", f"[{J},{B},{WIDE}]"),
    "something else reads them, or the layer": (
        BODY + " more = Relu(wide)", f"[{J},{B},{WIDE}]",
    ),
    "a term is neither shared by the batch nor a layer": (
        BODY.replace("Add(lanes, wide)", "Add(lanes, sum)").replace(
            "keys =", "more = Abs(position)  bias = MatMul(position, p)"
            " biases = Sin(bias)  sum = Add(wide, biases)  keys =",
        ), f"[{J},{B},2]",
    ),
}  # fmt: skip


@pytest.mark.parametrize("reason", CHANGED)
def test_keys_that_stay_are_named_with_the_reason(reason: str) -> None:
    body, more = CHANGED[reason]
    text = graph_of(f"{SIGNATURE}, float{more} more)", body)
    result = apply(HoistLinear(), read(text, **weights()))
    kept = "left 1 product with keys or values as they are: "
    assert any(note.startswith(kept + reason) for note in result.notes)
    wide = (J, B, WIDE)
    assert any(static_shape(node.outputs[0]) == wide for node in result.model.graph)


def test_stored_rows_that_differ_are_not_the_same_for_the_batch() -> None:
    stored = weights() | {"row": normal(B, 1, WIDE)}
    model = hoist(graph_of(f"{SIGNATURE})", BODY), **stored)
    wide = (J, B, WIDE)
    assert any(static_shape(node.outputs[0]) == wide for node in model.graph)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_split_attention_is_exact_in_float64(data: st.DataObject) -> None:
    """Any layout, repetition, bias, scale and mask of what motion reads."""
    batch, tokens = data.draw(st.integers(250, 260)), data.draw(st.integers(4, 6))
    heads, asked = data.draw(st.integers(2, 4)), data.draw(st.integers(1, 3))
    depth = data.draw(st.sampled_from([16, 24]))
    wide, first = depth * heads, data.draw(st.booleans())
    text, held = _attention(data, batch, tokens, heads, depth, asked, first)
    model = read(text, **held)
    feeds = {
        "q": RANDOM.normal(size=(batch * heads, asked, depth)),
        "map": RANDOM.normal(size=(1, tokens - 1, wide)),
        "position": RANDOM.normal(
            size=(batch, tokens, 2) if first else (tokens, batch, 2)
        ),
        "far": RANDOM.random((batch * heads, asked, tokens)) < 0.5,
    }
    (wanted,) = compute(model, feeds)
    result = apply(HoistLinear(), model)
    (found,) = compute(result.model, feeds)
    assert np.abs(wanted - found).max() <= 1e-9 * np.abs(wanted).max()
    whole = batch * tokens * wide
    assert all(np.prod(static_shape(n.outputs[0]) or ()) < whole for n in model.graph)


def _attention(
    data: st.DataObject,
    batch: int, tokens: int, heads: int, depth: int, asked: int, first: bool,
) -> tuple[str, dict[str, Any]]:  # fmt: skip
    """Write one attention; its rows are of the batch first, or of the tokens."""
    wide, lead = heads * depth, batch * heads
    shape = f"{batch},{tokens}" if first else f"{tokens},{batch}"
    repeat = data.draw(st.sampled_from(["Tile(map, times)", "Expand(map, whole)"]))
    mask = data.draw(st.sampled_from(["Add(scores, less)", "Where(far, low, scores)"]))
    bias = data.draw(st.sampled_from(["Add(linear, c)", "Add(c, linear)", "linear"]))
    place = data.draw(st.sampled_from(["Add(place, wide)", "wide"]))
    cut = "keys" if not first else "keyed"
    turn = "rows = Identity(more)" if first else "rows = Transpose<perm=[1,0,2]>(more)"
    split = "" if not first else "keyed = Transpose<perm=[1,0,2]>(keys)"
    body = (
        f"many = {repeat}  more = Concat<axis = 1>(many, row)  {turn}"
        f" linear = MatMul(position, p)  wide = {bias}  placed = {place}"
        f" keys = Add(placed, rows)  {split}"
        f" split = Reshape({cut}, heads)  turned = Transpose<perm = [1, 2, 0]>(split)"
        " scaled = Div(turned, root)  scores = MatMul(q, scaled)"
        f" no = Cast<to = 11>(far)  less = Mul(no, low)  masked = {mask}"
        " y = Softmax<axis = -1>(masked)"
    )
    body = body.replace("wide = linear ", "").replace("placed = wide ", "")
    if bias == "linear":
        body = body.replace("wide", "linear")
    if place == "wide":
        body = body.replace("placed", "linear" if bias == "linear" else "wide")
    text = graph_of(
        f"(double[{lead},{asked},{depth}] q, double[1,{tokens - 1},{wide}] map,"
        f" double[{shape},2] position, bool[{lead},{asked},{tokens}] far)"
        f" => (double[{lead},{asked},{tokens}] y)",
        body,
    )
    held = {
        "times": integers(batch, 1, 1), "whole": integers(batch, tokens - 1, wide),
        "row": np.repeat(RANDOM.normal(size=(1, 1, wide)), batch, 0),
        "p": RANDOM.normal(size=(2, wide)), "c": RANDOM.normal(size=wide),
        "place": RANDOM.normal(size=(1, tokens, wide) if first else (tokens, 1, wide)),
        "heads": integers(tokens, lead, depth),
        "root": np.array(1.7), "low": np.array(-3.0),
    }  # fmt: skip
    return text, held
