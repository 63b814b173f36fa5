"""Attention whose keys or values are partly the same for every batch."""

import pytest

from tests.passes.hoisted import graph_of, hoist, integers, normal, products
from tests.passes.small import ops

B, J, H, D, T = 300, 20, 4, 8, 2
WIDE = H * D
FIRST = f"float[{B},{H},{T},{D}] q", f"[{B},{H},{T},{J}]", f"1,{J}", f"{B},{J}"
MERGED = f"float[{B * H},{T},{D}] q", f"[{B * H},{T},{J}]", f"{J},1", f"{J},{B}"

KEYS = {
    "batch first": (*FIRST, "2,3,1", (B, J, H, D), "0,"),
    "one axis for batch and heads": (*MERGED, "2,0", (J, B * H, D), "1,"),
}


@pytest.mark.parametrize("case", KEYS)
def test_keys_are_what_the_batch_shares_and_positions(case: str) -> None:
    """The queries meet the shared keys, and positions before they are made wide."""
    queries, out, shared, whole, order, heads, first = KEYS[case]
    model = hoist(
        graph_of(
            f"({queries}, float[{shared},{WIDE}] map, float[{whole},2] position)"
            f" => (float{out} y)",
            "linear = MatMul(position, p)  wide = Add(linear, c)"
            " keys = Add(map, wide)  split = Reshape(keys, heads)"
            f" turned = Transpose<perm = [{first}{order}]>(split)"
            " scaled = Div(turned, root)  y = MatMul(q, scaled)",
        ),
        p=normal(2, WIDE), c=normal(WIDE), heads=integers(*heads),
        root=normal(1)[0],
    )  # fmt: skip
    queries_by_keys = B * H * T * J
    assert products(model) == queries_by_keys * (D + 2) + B * H * T * D * 2


@pytest.mark.parametrize("repeat", ["Tile(map, times)", "Expand(map, whole)"])
def test_values_that_are_repeated_for_the_batch_are_not_written_out(
    repeat: str,
) -> None:
    model = hoist(
        graph_of(
            f"(float[{B * H},{T},{J}] p, float[{J},1,{WIDE}] map)"
            f" => (float[{B * H},{T},{D}] y)",
            f"many = {repeat}  split = Reshape(many, heads)"
            " values = Transpose<perm = [1, 0, 2]>(split)  y = MatMul(p, values)",
        ),
        times=integers(1, B, 1), whole=integers(J, B, WIDE),
        heads=integers(J, B * H, D),
    )  # fmt: skip
    assert products(model) == B * H * T * J * D
    assert not {"Tile", "Expand"} & set(ops(model))


def test_values_are_what_the_batch_shares_and_positions() -> None:
    model = hoist(
        graph_of(
            f"(float[{B},{H},{T},{J}] p, float[1,{J},{WIDE}] map,"
            f" float[{B},{J},2] position) => (float[{B},{H},{T},{D}] y)",
            "wide = MatMul(position, w)  both = Add(wide, map)"
            " split = Reshape(both, heads)"
            " values = Transpose<perm = [0, 2, 1, 3]>(split)  y = MatMul(p, values)",
        ),
        w=normal(2, WIDE), heads=integers(B, J, H, D),
    )  # fmt: skip
    assert products(model) == B * H * T * J * (D + 2) + B * H * T * 2 * D


def test_keys_of_positions_alone_are_not_made_wide() -> None:
    model = hoist(
        graph_of(
            f"(float[{B},{H},{T},{D}] q, float[{B},{J},2] position)"
            f" => (float[{B},{H},{T},{J}] y)",
            "wide = MatMul(position, w)  split = Reshape(wide, heads)"
            " turned = Transpose<perm = [0, 2, 3, 1]>(split)  y = MatMul(q, turned)",
        ),
        w=normal(2, WIDE), heads=integers(B, J, H, D),
    )  # fmt: skip
    assert products(model) == B * H * T * 2 * (D + J)


STAY = {
    "keys that something else reads": (
        "keys = Add(map, wide)  more = Relu(keys)  split = Reshape(keys, heads)"
    ),
    "keys that are no sum": "keys = Relu(wide)  split = Reshape(keys, heads)",
    "keys that are not cut into heads": (
        "both = Add(map, wide)  keys = Transpose<perm = [0, 2, 1]>(both)"
        " split = Reshape(keys, heads)"
    ),
}


@pytest.mark.parametrize("case", STAY)
def test_other_keys_stay(case: str) -> None:
    more = f", float[{B},{J},{WIDE}] more" if "more" in STAY[case] else ""
    model = hoist(
        graph_of(
            f"(float[{B},{H},{T},{D}] q, float[1,{J},{WIDE}] map,"
            f" float[{B},{J},2] position) => (float[{B},{H},{T},{J}] y{more})",
            f"wide = MatMul(position, w)  {STAY[case]}"
            " turned = Transpose<perm = [0, 2, 3, 1]>(split)  y = MatMul(q, turned)",
        ),
        w=normal(2, WIDE), heads=integers(B, J, H, D),
    )  # fmt: skip
    assert products(model) == B * J * 2 * WIDE + B * H * T * D * J


def test_what_does_not_pay_is_left_as_it_was() -> None:
    model = hoist(
        graph_of(
            "(float[2,2,1,4] q, float[1,3,8] map, float[2,3,2] position)"
            " => (float[2,2,1,3] y)",
            "wide = MatMul(position, w)  keys = Add(map, wide)"
            " split = Reshape(keys, heads)"
            " turned = Transpose<perm = [0, 2, 3, 1]>(split)  y = MatMul(q, turned)",
        ),
        w=normal(2, 8), heads=integers(2, 3, 2, 4),
    )  # fmt: skip
    assert ops(model) == ["MatMul", "Add", "Reshape", "Transpose", "MatMul"]
    assert set(model.graph.initializers) == {"w", "heads"}
