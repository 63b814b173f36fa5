"""Drawn inputs and attributes for every operator but deformable attention."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.operators import Dialect
from me2e_compress.operators.grid_sampler import ScaledGrid
from tests.operators.running import in_float32

Arrays = dict[str, npt.NDArray[Any]]
Drawn = tuple[Arrays, Mapping[str, Any]]
Random = np.random.Generator


def single(**arrays: npt.NDArray[Any]) -> Arrays:
    ints = {n: a.astype(np.int32) for n, a in arrays.items() if a.dtype == np.int64}
    return in_float32({**arrays, **ints})


def aggregation(dialect: Dialect, random: Random) -> Drawn:
    cameras, levels, groups = random.integers(1, 4, 3)
    batch, anchors, points = random.integers(1, 3, 3)
    sizes = random.integers(0, 5, (cameras, levels, 2)).astype(np.int32)
    areas = sizes.prod(axis=2).reshape(-1)
    starts = (areas.cumsum() - areas).astype(np.int32).reshape(cameras, levels)
    shape = (batch, anchors, points, cameras)
    arrays = single(
        mc_ms_feat=random.normal(size=(batch, int(areas.sum()), groups * 2)),
        spatial_shape=sizes,
        scale_start_index=starts,
        sampling_location=random.uniform(-0.2, 1.2, (*shape, 2)),
        weights=random.uniform(size=(*shape, levels, groups)),
    )
    if dialect.name == "sparsedrive-v2":
        feature = random.integers(-127, 127, arrays["mc_ms_feat"].shape)
        arrays["mc_ms_feat"] = feature.astype(np.int8)
        arrays |= single(feat_scale=random.uniform(0.01, 0.02, groups * 2))
    return arrays, {}


def rotate(dialect: Dialect, random: Random) -> Drawn:
    image = random.normal(size=random.integers(1, 7, 3))
    angle, center = random.uniform(-180, 180, 1), random.uniform(0, 5, 2)
    mode = {"interpolation": int(random.integers(2))}
    return single(img=image, angle=angle, center=center), mode


def inverse(dialect: Dialect, random: Random) -> Drawn:
    size = int(random.integers(1, 6))
    matrix = random.normal(size=(2, 3, size, size)) + 4 * np.eye(size)
    return single(matrix=matrix), {}


def sampler(dialect: Dialect, random: Random) -> Drawn:
    dims = (dialect.operands[0].rank or 4) - 2
    batch, channels, *sizes = random.integers(1, 5, 2 + dims)
    grid = random.uniform(-1.6, 1.6, (batch, *random.integers(1, 4, dims), dims))
    if isinstance(dialect, ScaledGrid):
        grid = 10 * np.moveaxis(grid, -1, 1)
    options = map(int, (random.integers(2), random.integers(3), random.integers(2)))
    names = (attribute.name for attribute in dialect.attributes)
    image = random.normal(size=(batch, channels, *sizes))
    return single(input=image, grid=grid), dict(zip(names, options, strict=True))


def selection(dialect: Dialect, random: Random) -> Drawn:
    batch, rows, width, taken = (int(each) for each in random.integers(1, 6, 4))
    arrays = single(
        feat=random.normal(size=(batch, rows, width)),
        flag=random.integers(0, 2, (batch, rows)).astype(np.int32),
        invalid=random.normal(size=width),
    )
    return arrays, {"P": taken}


def pool(dialect: Dialect, random: Random) -> Drawn:
    cells = random.permutation(12)[:5]
    lengths = random.integers(1, 4, 5)
    total = int(lengths.sum())
    arrays = single(
        depth=random.uniform(size=(2, 3, 2, 2)),
        feat=random.normal(size=(2, 2, 2, 4)),
        ranks_depth=random.integers(0, 24, total),
        ranks_feat=random.integers(0, 8, total),
        ranks_bev=np.repeat(cells, lengths),
        interval_starts=lengths.cumsum() - lengths,
        interval_lengths=lengths,
    )
    return arrays, {"out_height": 3, "out_width": 4}


def attention(dialect: Dialect, random: Random) -> Drawn:
    batch, queries, keys, width, heads = map(int, random.integers(1, 6, 5))
    options = {"heads": heads} if dialect.attributes else {}
    width *= options.get("heads", 1)
    return single(
        query=random.normal(size=(batch, queries, width)),
        key=random.normal(size=(batch, keys, width)),
        value=random.normal(size=(batch, keys, width)),
    ), options


def convolution(dialect: Dialect, random: Random) -> Drawn:
    groups, parts = (int(each) for each in random.integers(1, 3, 2))
    kernel, padding = random.integers(1, 4, 2), random.integers(0, 2, 2)
    stride, dilation = random.integers(1, 3, 2), random.integers(1, 3, 2)
    size = random.integers(5, 8, 2)
    out = (size + 2 * padding - dilation * (kernel - 1) - 1) // stride + 1
    taps = int(kernel.prod())
    arrays = single(
        input=random.normal(size=(2, 4, *size)),
        offset=random.normal(size=(2, parts * taps * 2, *out)) * 2,
        mask=random.uniform(size=(2, parts * taps, *out)),
        weight=random.normal(size=(6, 4 // groups, *kernel)),
    )
    if random.integers(2):
        arrays |= single(bias=random.normal(size=6))
    lists = (tuple(map(int, each)) for each in (stride, padding, dilation))
    values = (*lists, groups, parts)
    return arrays, dict(zip((a.name for a in dialect.attributes), values, strict=True))


def histogram(dialect: Dialect, random: Random) -> Drawn:
    """Draw numbers with a reach at, below or above a power of two, or none at all."""
    values = random.normal(size=random.integers(0, 400)) * 10 ** random.uniform(-35, 35)
    if random.integers(2):
        values = np.ldexp(1.0, random.integers(-130, 127, values.size))
    values = np.append(values, 0).astype(np.float32)
    low, high = (np.asarray(value) for value in (values.min(), values.max()))
    return {"X": values, "low": low, "high": high}, {}


DRAWS: dict[str, Callable[[Dialect, Random], Drawn]] = {
    "deformable-aggregation": aggregation,
    "rotate": rotate,
    "inverse": inverse,
    "grid-sampler-2d": sampler,
    "grid-sampler-3d": sampler,
    "select-and-pad": selection,
    "bev-pool": pool,
    "multi-head-attention": attention,
    "deformable-convolution": convolution,
    "histogram": histogram,
}
