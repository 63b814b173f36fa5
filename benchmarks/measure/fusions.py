"""Which patterns pay as fused nodes, by shape: their nodes against the fused node.

    python -m benchmarks.measure.fusions [--only attention] [--rounds 15]

Every pattern that ``fuse-operators`` and ``fuse-kernels`` know is written as exporters
write it, at the shapes of the driver, VAD-tiny and UniAD-tiny and at smaller and larger
ones, and fused by the pass, its gate open. Both graphs run in turn in one process on
one thread: least CPU microseconds. Small patterns stand several times in a graph, each
with inputs of its own, so that starting a run counts little. Below 1, the fused node is
faster; *left* is what the gate leaves.
"""

import argparse
import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from unittest import mock

import numpy as np
import onnx_ir as ir
import onnxruntime as ort

from benchmarks.tools.processes import in_turn
from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.provenance import Provenance
from me2e_compress.passes.base import Context
from me2e_compress.passes.fuse_kernels import (
    FuseKernels,
    attention,
    grid_sample,
    raw_attention,
)
from me2e_compress.passes.fuse_operators import FuseOperators
from me2e_compress.runtime.profile import processor
from me2e_compress.runtime.session import Session

HEAD = '<ir_version: 10, opset_import: ["" : 17, "me2e" : 1]>'
WHOLE = ModuleMap.whole()
OPEN = (
    *(
        (module, "pays", mock.Mock(return_value=True))
        for module in (attention, grid_sample)
    ),
    *((attention, name, 0) for name in ("LEAST_QUERIES", "LEAST_KEYS")),
    (raw_attention, "LEAST_POINTS", 0),
)
"""What opens the gates: modules, names and values."""
SMALL = 2_000_000
"""Products of a pattern below which it stands eight times in a graph."""
COPIES = 8


@dataclasses.dataclass(frozen=True)
class Pattern:
    """One pattern at one shape.

    Attributes:
        name: the pattern, and its shape in words.
        inputs: shape of every input of a copy.
        body: nodes from the inputs to ``y``, every name with ``@`` behind it.
        constants: initializers, as ONNX text.
        output: shape of ``y``.
        products: multiply-accumulates, roughly.
    """

    name: str
    inputs: Mapping[str, tuple[int, ...]]
    body: str
    constants: str
    output: tuple[int, ...]
    products: int

    @property
    def copies(self) -> int:
        """How often it stands in the graph."""
        return COPIES if self.products < SMALL else 1

    def graph(self) -> ir.Model:
        """Write it as often as it shall stand, every copy with inputs of its own."""
        ports, outputs, lines = list[str](), list[str](), list[str]()
        for copy in range(self.copies):
            for name, shape in self.inputs.items():
                ports.append(f"float{_dims(shape)} {name}{copy}")
            outputs.append(f"float{_dims(self.output)} y{copy}")
            lines.append(self.body.replace("@", str(copy)))
        text = (
            f"{HEAD} m ({', '.join(ports)}) => ({', '.join(outputs)})"
            f" <{self.constants}> {{ {' '.join(lines)} }}"
        )
        model = ir.from_onnx_text(text)
        graph.infer_shapes(model)
        for place, node in enumerate(model.graph):
            node.name = f"node {place}"
            past = Provenance(WHOLE.names()[0], (str(node.outputs[0].name),))
            provenance.stamp(node, past)
        return model


def attention_of(
    queries: int, keys: int, heads: int, channels: int, *, rows: bool
) -> Pattern:
    """Write attention, its heads beside each other in ``rows``, or in the batch."""
    width = heads * channels
    core = (
        "qs@ = Mul({q}, f) sc@ = MatMul(qs@, kt@) w@ = Softmax<axis=-1>(sc@)"
        " {z} = MatMul(w@, {v})"
    )
    constants = f"float f = {{{channels**-0.5}}}"
    if rows:
        parts = "".join(
            f"{name}p@ = Reshape({name}@, split)"
            f" {name}t@ = Transpose<perm=[0,2,{perm}]>({name}p@) "
            for name, perm in (("q", "1,3"), ("k", "3,1"), ("v", "1,3"))
        )
        body = parts + core.format(q="qt@", v="vt@", z="z@")
        body += " zt@ = Transpose<perm=[0,2,1,3]>(z@) y@ = Reshape(zt@, joined)"
        constants += f", int64[4] split = {{0, 0, {heads}, {channels}}}"
        constants += f", int64[3] joined = {{0, 0, {width}}}"
        shapes = [(1, count, width) for count in (queries, keys, keys)]
    else:
        body = "kt@ = Transpose<perm=[0,2,1]>(k@) " + core.format(
            q="q@", v="v@", z="y@"
        )
        shapes = [(heads, count, channels) for count in (queries, keys, keys)]
    name = f"attention, {'rows' if rows else 'batch'}: {queries} queries, {keys} keys,"
    inputs = dict(zip("qkv", shapes, strict=True))
    macs = 2 * queries * keys * width
    return Pattern(
        f"{name} {heads} x {channels}", inputs, body, constants, shapes[0], macs
    )


def sampling_of(
    channels: int, side: int, points: int, mode: str, *, rows: bool, turned: bool
) -> Pattern:
    """Write GridSample of a square map at points, from rows and read as rows or not."""
    image = (1, side * side, channels) if rows else (1, channels, side, side)
    given = "t@ = Transpose<perm=[0,2,1]>(x@) m@ = Reshape(t@, image) " if rows else ""
    body = given + (
        f's@ = GridSample<mode="{mode}", padding_mode="zeros", align_corners=0>'
        f"({'m@' if rows else 'x@'}, at@)"
    )
    constants = f"int64[4] image = {{1, {channels}, {side}, {side}}}"
    constants += f", int64[3] flat = {{1, {channels}, {points}}}"
    if turned:
        body += " f@ = Reshape(s@, flat) y@ = Transpose<perm=[0,2,1]>(f@)"
        output: tuple[int, ...] = (1, points, channels)
    else:
        body += " y@ = Reshape(s@, flat)"
        output = (1, channels, points)
    kind = f"{'rows' if rows else 'map'} to {'rows' if turned else 'map'}"
    return Pattern(
        f"GridSample, {mode}, {kind}: {channels} channels, {side} x {side}, {points}"
        " points",
        {"x": image, "at": (1, 1, points, 2)},
        body,
        constants,
        output,
        4 * channels * points,
    )


def deformable_of(
    queries: int, heads: int, channels: int, sides: Sequence[int], points: int
) -> Pattern:
    """Write deformable attention on square maps as mmcv's Python code is exported."""
    areas, levels = [side * side for side in sides], len(sides)
    names = [f"{{}}{level}_@" for level in range(levels)]
    lines = [
        "a@ = Mul(at@, two) g@ = Sub(a@, one)",
        f"{', '.join(n.format('v') for n in names)} = Split<axis=1>(value@, areas)",
        f"{', '.join(n.format('g') for n in names)} = Split<axis=3>(g@, each)",
    ]
    constants = [
        "float two = {2}, float one = {1}",
        "int64[1] stacked = {-2}, int64[1] last = {-1}",
        f"int64[{levels}] areas = {{{_list(areas)}}}",
        f"int64[{levels}] each = {{{_list([1] * levels)}}}",
        f"int64[5] per_level = {{1, {queries}, {heads}, {points}, 2}}",
        f"int64[4] grid = {{{heads}, {queries}, {points}, 2}}",
        f"int64[4] flat = {{{heads}, {channels}, {queries}, {levels * points}}}",
        f"int64[4] ones = {{{heads}, 1, {queries}, {levels * points}}}",
        f"int64[3] joined = {{1, {heads * channels}, {queries}}}",
    ]
    for level, side in enumerate(sides):
        constants += [
            f"int64[3] rows{level} = {{1, {side * side}, {heads * channels}}}",
            f"int64[4] map{level} = {{{heads}, {channels}, {side}, {side}}}",
        ]
        line = (
            "r~_@ = Reshape(v~_@, rows~) t~_@ = Transpose<perm=[0,2,1]>(r~_@)"
            " m~_@ = Reshape(t~_@, map~) h~_@ = Reshape(g~_@, per_level)"
            " i~_@ = Transpose<perm=[0,2,1,3,4]>(h~_@) j~_@ = Reshape(i~_@, grid)"
            ' s~_@ = GridSample<mode="bilinear", padding_mode="zeros",'
            " align_corners=0>(m~_@, j~_@) u~_@ = Unsqueeze(s~_@, stacked)"
        )
        lines.append(line.replace("~", str(level)))
    lines.append(
        f"c@ = Concat<axis=-2>({', '.join(n.format('u') for n in names)})"
        " d@ = Reshape(c@, flat) wt@ = Transpose<perm=[0,2,1,3,4]>(share@)"
        " w@ = Reshape(wt@, ones) p@ = Mul(d@, w@)"
        " e@ = ReduceSum<keepdims=0>(p@, last) f@ = Reshape(e@, joined)"
        " y@ = Transpose<perm=[0,2,1]>(f@)"
    )
    form = (1, queries, heads, levels, points)
    return Pattern(
        f"deformable attention: {queries} queries, {levels} x {points} points,"
        f" {heads} x {channels}, {sum(areas)} pixels",
        {"value": (1, sum(areas), heads, channels), "at": (*form, 2), "share": form},
        " ".join(lines),
        ", ".join(constants),
        (1, queries, heads * channels),
        4 * math.prod(form) * channels,
    )


def raw_of(
    queries: int, heads: int, channels: int, sides: Sequence[int], points: int
) -> Pattern:
    """Write the sum and the softmax in front of a fused deformable attention."""
    areas, levels = [side * side for side in sides], len(sides)
    starts = [sum(areas[:level]) for level in range(levels)]
    form = (1, queries, heads, levels, points)
    body = (
        "at@ = Add(near@, away@) soft@ = Softmax<axis=-1>(scores@)"
        " share@ = Reshape(soft@, form) y@ = me2e.MultiScaleDeformableAttention"
        "(value@, sizes, starts, at@, share@)"
    )
    constants = (
        f"int64[{levels},2] sizes = {{{_list([s for s in sides for _ in range(2)])}}},"
        f" int64[{levels}] starts = {{{_list(starts)}}},"
        f" int64[5] form = {{{_list(form)}}}"
    )
    inputs = {
        "value": (1, sum(areas), heads, channels),
        "near": (1, queries, 1, levels, 1, 2),
        "away": (*form, 2),
        "scores": (*form[:3], levels * points),
    }
    return Pattern(
        f"sum and softmax: {queries} queries, {levels} x {points} points,"
        f" {heads} x {channels}, {sum(areas)} pixels",
        inputs,
        body,
        constants,
        (1, queries, heads, channels),
        4 * math.prod(form) * channels,
    )


def _list(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def _dims(shape: Sequence[int]) -> str:
    return f"[{','.join(map(str, shape))}]"


ATTENTIONS = (
    # queries, keys, heads, channels; rows or heads in the batch: the driver's, VAD's,
    # and UniAD's, then others
    (150, 150, 4, 16, True), (768, 720, 4, 16, True), (64, 64, 4, 16, True),
    (300, 300, 8, 32, True), (901, 901, 8, 32, True), (1, 300, 8, 32, True),
    (64, 256, 4, 128, True), (150, 64, 4, 128, True), (4096, 256, 8, 32, True),
    (8, 256, 8, 32, False), (16, 256, 8, 32, False), (49, 256, 4, 16, False),
    (300, 64, 8, 32, False), (1024, 768, 8, 32, False), (300, 64, 4, 128, False),
)  # fmt: skip
SAMPLINGS = (
    # channels, side, points, mode, rows, turned
    (64, 28, 768, "bilinear", True, True), (64, 28, 150, "bilinear", True, True),
    (256, 100, 10000, "nearest", True, True), (16, 32, 768, "bilinear", True, True),
    (16, 32, 768, "nearest", True, True), (64, 100, 16, "nearest", False, True),
    (64, 100, 150, "bilinear", False, True), (256, 100, 10000, "bilinear", False, True),
)  # fmt: skip
DEFORMABLE = (
    # queries, heads, channels, sides of the maps, points of a level
    (768, 4, 16, (28,), 4), (300, 8, 32, (100,), 4), (10000, 8, 32, (100,), 4),
    (1, 4, 8, (8,), 1), (2000, 4, 8, (100,), 1), (300, 8, 32, (32, 16, 8, 4), 4),
    (300, 4, 16, (32, 16, 8, 4), 1), (300, 4, 16, (32, 16, 8, 4), 2),
)  # fmt: skip


def patterns() -> Iterator[Pattern]:
    """Yield every pattern at its shapes."""
    for *sizes, rows in ATTENTIONS:
        yield attention_of(*sizes, rows=rows)
    for channels, side, points, mode, rows, turned in SAMPLINGS:
        yield sampling_of(channels, side, points, mode, rows=rows, turned=turned)
    for make in (deformable_of, raw_of):
        for case in DEFORMABLE:
            yield make(*case)


def fused(pattern: Pattern, model: ir.Model, *, gated: bool) -> ir.Model | None:
    """Fuse a pattern, its gate open unless ``gated``; None where it is left."""
    step = FuseOperators() if pattern.name.startswith("deformable") else FuseKernels()
    copy = model.clone()
    with contextlib.ExitStack() as stack:
        for module, name, value in () if gated else OPEN:
            stack.enter_context(mock.patch.object(module, name, value))
        result = step.run(copy, Context(WHOLE))
    return copy if result.changes else None


def row(pattern: Pattern, rounds: int) -> str:
    """Measure one pattern: microseconds of its nodes, and the ratio."""
    model, draws = pattern.graph(), np.random.default_rng(0)
    fast = fused(pattern, model, gated=False)
    if fast is None:
        return f"{pattern.name} | no pattern | |"
    feeds = {}
    for copy, (name, shape) in product(range(pattern.copies), pattern.inputs.items()):
        drawn = draws.uniform(0, 1, shape)
        feeds[f"{name}{copy}"] = (drawn / 8 if name == "away" else drawn).astype("f4")
    sessions = {"nodes": Session(model, threads=1), "fused": Session(fast, threads=1)}
    works = {name: partial(each.run, feeds) for name, each in sessions.items()}
    times = {name: min(taken) for name, taken in in_turn(works, rounds).items()}
    left = "" if fused(pattern, model, gated=True) else "left"
    nodes_us = times["nodes"] / pattern.copies * 1e6
    ratio = times["fused"] / times["nodes"]
    return f"{pattern.name} | {nodes_us:.0f} | {ratio:.2f} | {left}"


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="part of the pattern's name")
    parser.add_argument("--rounds", type=int, default=15)
    chosen = parser.parse_args()
    print(f"{processor()}, one thread, onnxruntime {ort.__version__}\n")
    print("pattern | nodes, µs | fused | gate\n---|---:|---:|---")
    for pattern in patterns():
        if chosen.only in pattern.name:
            print(row(pattern, chosen.rounds), flush=True)


if __name__ == "__main__":
    main()
