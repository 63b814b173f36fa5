"""Deformable attention as exporters write it, and as none does, in ONNX text."""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import infer_shapes
from tests.passes.small import read

FUSED = "MultiScaleDeformableAttention"


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of a deformable attention: images, queries, heads, points, channels."""

    n: int = 2
    q: int = 5
    m: int = 3
    p: int = 4
    d: int = 6
    levels: tuple[tuple[int, int], ...] = ((6, 8), (3, 4))

    @property
    def pixels(self) -> int:
        return sum(height * width for height, width in self.levels)


def decomposed(
    s: Sizes,
    *,
    opset: int = 17,
    mode: str = "bilinear",
    split: bool = False,
    merge: str = "",
    masked: bool = False,
) -> ir.Model:
    """mmcv's ``multi_scale_deformable_attn_pytorch`` as torch exports it.

    Args:
        s: sizes.
        opset: of ONNX.
        mode: what GridSample calls its interpolation.
        split: levels by Split and Squeeze, as dynamo writes them, not Slice and Gather.
        merge: ReduceSum or ReduceMean over the images behind it.
        masked: that of the images, times a mask.
    """
    shapes: dict[str, list[int]] = {"two": [], "one": []}
    lines = ["a = Mul(locations, two)", "grids = Sub(a, one)"]
    lines += _levels(s, shapes, split)
    start = 0
    for i, (height, width) in enumerate(s.levels):
        shapes |= {
            f"from{i}": [start],
            f"to{i}": [start + height * width],
            f"level{i}": [i],
            f"rows{i}": [s.n, height * width, s.m * s.d],
            f"map{i}": [s.n * s.m, s.d, height, width],
            f"grid{i}": [s.n * s.m, s.q, s.p, 2],
        }
        start += height * width
        lines += [
            f"r{i} = Reshape(v{i}, rows{i})",
            f"t{i} = Transpose<perm = [0, 2, 1]>(r{i})",
            f"image{i} = Reshape(t{i}, map{i})",
            f"gt{i} = Transpose<perm = [0, 2, 1, 3, 4]>(g{i})",
            f"gr{i} = Reshape(gt{i}, grid{i})",
            f's{i} = GridSample<mode = "{mode}", padding_mode = "zeros",'
            f" align_corners = 0>(image{i}, gr{i})",
            f"u{i} = Unsqueeze(s{i}, stacked)",
        ]
    count = len(s.levels)
    stack = ", ".join(f"u{i}" for i in range(count))
    shapes |= {
        "stacked": [-2],
        "axis1": [1],
        "axis3": [3],
        "last": [-1],
        "flat": [s.n * s.m, s.d, s.q, count * s.p],
        "ones": [s.n * s.m, 1, s.q, count * s.p],
        "joined": [s.n, s.m * s.d, s.q],
    }
    lines += [
        f"stack = Concat<axis = -2>({stack})",
        "samples = Reshape(stack, flat)",
        "wt = Transpose<perm = [0, 2, 1, 3, 4]>(weights)",
        "w = Reshape(wt, ones)",
        "product = Mul(samples, w)",
        "total = ReduceSum<keepdims = 0>(product, last)",
        "heads = Reshape(total, joined)",
        f"{'per_image' if merge else 'y'} = Transpose<perm = [0, 2, 1]>(heads)",
    ]
    if masked:
        lines.append("seen = Mul(per_image, mask)")
    if merge == "ReduceSum":
        shapes["first"] = [0]
        lines.append(f"y = ReduceSum({'seen' if masked else 'per_image'}, first)")
    elif merge:
        lines.append(f"y = {merge}<axes = [0]>({'seen' if masked else 'per_image'})")
    port = f", float[{s.n},{s.q},1] mask" if masked else ""
    text = f"""<ir_version: 9, opset_import: ["" : {opset}]>
    g (float[{s.n},{s.pixels},{s.m},{s.d}] value,
       float[{s.n},{s.q},{s.m},{count},{s.p},2] locations,
       float[{s.n},{s.q},{s.m},{count},{s.p}] weights{port})
       => (float[{1 if merge else s.n},{s.q},{s.m * s.d}] y) {{
    """ + "\n".join(lines) + "}"  # fmt: skip
    constants = {
        name: np.array(sizes, np.int64) for name, sizes in shapes.items() if sizes
    }
    return read(text, two=np.float32(2), one=np.float32(1), **constants)


def _levels(s: Sizes, shapes: dict[str, list[int]], split: bool) -> list[str]:
    """Write how each level's values and positions are taken out of all."""
    count = len(s.levels)
    if split:
        shapes["areas"] = [height * width for height, width in s.levels]
        shapes["each"] = [1] * count
        values = ", ".join(f"v{i}" for i in range(count))
        grids = ", ".join(f"gk{i}" for i in range(count))
        return [
            f"{values} = Split<axis = 1>(value, areas)",
            f"{grids} = Split<axis = 3>(grids, each)",
            *(f"g{i} = Squeeze(gk{i}, axis3)" for i in range(count)),
        ]
    return [
        line
        for i in range(count)
        for line in (
            f"v{i} = Slice(value, from{i}, to{i}, axis1)",
            f"gk{i} = Gather<axis = 3>(grids, level{i})",
            f"g{i} = Squeeze(gk{i}, axis3)",
        )
    ]


def inferred(model: ir.Model) -> ir.Model:
    infer_shapes(model)
    return model


SAMPLED = 'GridSample<mode = "bilinear", padding_mode = "zeros">'
PLAIN = """<ir_version: 9, opset_import: ["" : 17]>
g (float[6,4,5,7] image, float[6,9,3,2] grid, WEIGHTS weights) => (float y) {
    s = SAMPLER(image, grid)
    m = Mul(weights, s)
    y = ReduceSum<keepdims = KEEP>(m, AXES)
}"""


def plain(
    sampler: str = SAMPLED,
    weights: str = "float[6,1,9,3]",
    axes: tuple[int, ...] = (3,),
    keep: int = 0,
) -> ir.Model:
    """One level, as a graph that no exporter of an attention wrote may have it."""
    text = PLAIN.replace("SAMPLER", sampler).replace("WEIGHTS", weights)
    text = text.replace("AXES", "axes").replace("KEEP", str(keep))
    rank = 4 if keep else 4 - len(axes)
    text = text.replace("float y", f"float[{','.join('ABCD'[:rank])}] y")
    return read(text, axes=np.array(axes, np.int64))
