"""Bilinear sampling that is written with Gather is GridSample, and then attention."""

import itertools
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.passes.digits import whole
from me2e_compress.passes.fuse_operators import FuseOperators
from me2e_compress.passes.fuse_operators.gathered import AT, BEYOND, PAIR, Sampling
from me2e_compress.passes.fuse_operators.views import View
from tests.passes.decomposed import FUSED, PLAIN
from tests.passes.small import apply, ops, read
from tests.passes.test_fuse_operators import fused

TAKEN = {  # what is gathered of, the index of a corner, and what is gathered
    "GatherElements": "d = Reshape(p, lines)",
    "Gather": "q = Transpose<perm = [0, 2, 3, 1]>(p) d = Reshape(q, table)",
    "GatherND": "d = Transpose<perm = [0, 2, 3, 1]>(p)",
}
CORNER = {
    "GatherElements": """r{c} = Reshape(j{c}, line) e{c} = Expand(r{c}, wide)
    u{c} = GatherElements<axis = 2>(d, e{c}) t{c} = Reshape(u{c}, four)""",
    "Gather": "k{c} = Add(j{c}, first) t{c} = Gather<axis = 0>(d, k{c})",
    "GatherND": """a{c} = Unsqueeze(i{a}y, last) b{c} = Unsqueeze(i{b}x, last)
    k{c} = Concat<axis = 3>(image_of, a{c}, b{c}) t{c} = GatherND(d, k{c})""",
}


FLOOR = {
    "apart": """g{n} = Gather<axis = 3>(grid, at{n}) h{n} = Add(g{n}, one)
    s{n} = Mul(h{n}, half{n}) p{n} = Sub(s{n}, middle) f{n} = Floor(p{n})""",
    "clipped": """g{n} = Gather<axis = 3>(grid, at{n}) h{n} = Add(g{n}, one)
    s{n} = Mul(h{n}, half{n}) a{n} = Sub(s{n}, middle) p{n} = Clip(a{n}, before, behind)
    f{n} = Floor(p{n})""",
    "together": """p{n} = Gather<axis = 3>(both, at{n})
    f{n} = Gather<axis = 3>(floors, at{n})""",
}


def by_gather(op: str, *, pad: int, masked: bool, floor: str) -> str:
    """Write out what samples ``image`` at ``grid``; return the lines."""
    lines = ["p = Pad(image, pads)" if pad else "p = Identity(image)", TAKEN[op]]
    if floor == "together":
        lines.append("""one_more = Add(grid, one) sized = Mul(one_more, halves)
        both = Sub(sized, middle) floors = Floor(both)""")
    for n, c in itertools.product("xy", "01"):
        if c == "0":
            lines.append(f"""{FLOOR[floor].format(n=n)} z{n} = Sub(p{n}, f{n})""")
        lines.append(f"""m{c}{n} = Add(f{n}, step{c})
        c{c}{n} = Clip(m{c}{n}, zero, end{n}) i{c}{n} = Cast<to = 7>(c{c}{n})
        v{c}{n} = {("Sub(one, z", "Identity(z")[int(c)]}{n})""")
        inside = f"""o{c}{n} = Equal(c{c}{n}, m{c}{n}) q{c}{n} = Cast<to = 1>(o{c}{n})
        w{c}{n} = Mul(v{c}{n}, q{c}{n})"""
        lines.append(inside if masked else f"w{c}{n} = Identity(v{c}{n})")
    axis = "first_axis" if op == "GatherElements" else "last"
    for a, b in itertools.product("01", "01"):
        lines.append(f"""y{a}{b} = Mul(i{a}y, width) j{a}{b} = Add(y{a}{b}, i{b}x)
        {CORNER[op].format(a=a, b=b, c=a + b)} l{a}{b} = Mul(w{b}x, w{a}y)
        n{a}{b} = Unsqueeze(l{a}{b}, {axis}) x{a}{b} = Mul(t{a}{b}, n{a}{b})""")
    lines.append("t0 = Add(x10, x01) t1 = Add(x00, t0) t = Add(t1, x11)")
    turn = "Identity" if axis == "first_axis" else "Transpose<perm = [0, 3, 1, 2]>"
    text = PLAIN.replace(
        "s = SAMPLER(image, grid)", "\n".join([*lines, f"s = {turn}(t)"])
    )
    for old, new in (("WEIGHTS", "float[3]"), ("KEEP", "0"), ("AXES", "last")):
        text = text.replace(old, new)
    return text.replace("float y", "float[6,4,9] y")


def model_of(
    op: str, pad: int = 1, masked: bool = False, corners: int = 0, floor: str = "apart"
) -> ir.Model:
    rows, columns, image = 5 + 2 * pad, 7 + 2 * pad, np.arange(6).reshape(6, 1, 1)
    floats: dict[str, Any]
    floats = {"one": 1, "zero": 0, "step0": pad, "step1": pad + 1, "endx": columns - 1}
    floats |= {"endy": rows - 1, "middle": 0.5}
    floats |= {"halfx": (7 - corners) / 2, "halfy": (5 - corners) / 2}
    floats |= {"halves": [3.5, 2.5], "before": -1.5, "behind": 7.5}
    whole: dict[str, Any] = {
        "atx": 0,
        "aty": 1,
        "width": columns,
        "last": [-1],
        "first_axis": [1],
    }
    whole |= {"lines": [6, 4, -1], "table": [-1, 4], "line": [6, 1, 27]}
    whole |= {"wide": [6, 4, 27], "four": [6, 4, 9, 3], "first": image * rows * columns}
    whole |= {"pads": [0, 0, pad, pad] * 2}
    whole |= {"image_of": np.broadcast_to(image[..., None], (6, 9, 3, 1))}
    known: dict[str, Any]
    known = {name: np.array(each, np.int64) for name, each in whole.items()}
    known |= {name: np.float32(each) for name, each in floats.items()}
    text = by_gather(op, pad=pad, masked=masked, floor=floor)
    for n in "xy" * corners:
        text = text.replace(f"Sub(s{n}, middle)", f"Identity(s{n})")
    return read(text, **known)


@pytest.mark.parametrize("op", TAKEN)
@pytest.mark.parametrize(
    ("pad", "masked", "floor"),
    [
        (1, False, "apart"),
        (0, True, "apart"),
        (1, False, "clipped"),
        (0, True, "together"),
    ],
)
def test_corners_are_found(op: str, pad: int, masked: bool, floor: str) -> None:
    model = model_of(op, pad, masked, floor=floor)
    result = fused(model)
    assert FUSED in ops(model)
    assert not {"Floor", op} & {*ops(model)}
    assert "written as GridSample: 1 samplings by Gather" in result.notes


@pytest.mark.parametrize("op", TAKEN)
def test_aligned_corners_stay_aligned(op: str) -> None:
    model = model_of(op, corners=1)
    fused(model)
    (node,) = (node for node in model.graph if node.op_type == "GridSample")
    assert node.attributes["align_corners"].value == 1
    assert node.inputs[1] is model.graph.inputs[1]


def test_positions_may_have_y_first() -> None:
    model = model_of("Gather")
    for name, index in (("atx", 1), ("aty", 0)):
        model.graph.initializers[name].const_value = ir.tensor(np.int64(index))
    fused(model)
    assert FUSED in ops(model)


@pytest.mark.parametrize(
    ("opset", "reason"), [(15, "needs opset 16"), (17, "it differs by")]
)
def test_what_is_no_sampling_of_zeros_stays(opset: int, reason: str) -> None:
    model = model_of("GatherElements", pad=0)  # what is outside is the nearest pixel
    model.opset_imports[""] = opset
    result = apply(FuseOperators(), model)
    assert result.changes == 0
    (note,) = result.notes
    assert reason in note


@pytest.mark.parametrize("shared", [True, False], ids=["one value", "x and y apart"])
def test_positions_are_drawn_over_each_axis_of_the_map(shared: bool) -> None:
    """The map has 4 rows and 40 columns: x is the first of a pair."""
    image = View(ir.Value(name="image"), tuple(map(whole, "bcrw", (1, 2, 4, 40))))
    pair = (whole(AT, 300), whole(PAIR, 2))
    at = [View(ir.Value(name="xy"), pair)]
    if not shared:
        at = [View(ir.Value(name=each), pair[:1]) for each in "xy"]
    sampling = Sampling(image, image, (1, 2, 4, 40), tuple(at), (10.0, 1.0), (0.0, 1.5))

    drawn = sampling.draw(np.random.default_rng(0))

    x, y = np.concatenate([drawn[e.value].reshape(300, -1) for e in at], 1).T
    for places, size, scale, shift in ((x, 40, 10.0, 0.0), (y, 4, 1.0, 1.5)):
        pixels = places * scale + shift
        assert pixels.min() < 0 < size - 1 < pixels.max()
        assert (pixels > -BEYOND - 0.01).all()
        assert (pixels < size + BEYOND - 0.99).all()
