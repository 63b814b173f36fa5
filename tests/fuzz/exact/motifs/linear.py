"""Linear layers in the spellings of exporters, in a row and behind sums."""

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.values import Val, is_static, product


def layer(b: Builder, x: Val, width: int | None = None) -> Val:
    """Multiply rows by a matrix, with or without a bias, in one of the spellings."""
    columns = width or b.rng.choice((3, 4, 6, 8, 12, 16))
    spellings = [_matmul, _matmul, _turned]
    if x.rank == 2:
        spellings += [gemm, gemm]
    if x.rank > 2:
        spellings.append(_flat_gemm)
    if x.rank == 3 and not b.is_double:
        spellings.append(_conv)
    if b.opset >= 12:
        spellings.append(_einsum)
    return b.rng.choice(spellings)(b, x, columns)


def _biased(b: Builder, product_: Val) -> Val:
    if b.chance(0.35):
        return product_
    shape = b.rng.choice([(product_.width,)] * 6 + [(1, product_.width), (1,), ()])
    bias = b.weight(shape, 0.5)
    kind = b.rng.choice(("Add", "Add", "Add", "Sub"))
    return sp.either_way(b, kind, product_, bias)


def _matmul(b: Builder, x: Val, columns: int) -> Val:
    return _biased(b, sp.matmul(b, x, b.weight((x.width, columns))))


def _turned(b: Builder, x: Val, columns: int) -> Val:
    weight = b.weight((columns, x.width), x.width**-0.5)
    return _biased(b, sp.matmul(b, x, sp.transpose(b, weight, (1, 0))))


def gemm(b: Builder, x: Val, columns: int) -> Val:
    """Write one Gemm on a weight that others may have."""
    turned = b.rng.randint(0, 1)
    shape = (columns, x.width) if turned else (x.width, columns)
    inputs = [x, b.weight(shape, x.width**-0.5)]
    attributes: dict[str, float | int] = {}
    if turned or b.chance(0.3):
        attributes["transB"] = turned
    if b.chance(0.25):
        attributes["alpha"] = b.rng.choice((0.5, 2.0, -1.5))
    if b.chance(0.7):
        inputs.append(b.weight(b.rng.choice([(columns,)] * 4 + [(1, columns), ()]), 1))
        if b.chance(0.2):
            attributes["beta"] = b.rng.choice((0.0, 0.5, 2.0))
    return b.op("Gemm", inputs, (*x.shape[:-1], columns), attributes)


def _flat_gemm(b: Builder, x: Val, columns: int) -> Val:
    flat = sp.reshape(b, x, (product(x.shape[:-1]), x.width))
    return sp.reshape(b, gemm(b, flat, columns), (*x.shape[:-1], columns))


def _conv(b: Builder, x: Val, columns: int) -> Val:
    turned = sp.transpose(b, x, (0, 2, 1))
    inputs = [turned, b.weight((columns, x.width, 1), x.width**-0.5)]
    if b.chance(0.6):
        inputs.append(b.weight((columns,), 0.5))
    shape = (x.shape[0], columns, x.shape[1])
    return sp.transpose(b, b.op("Conv", inputs, shape), (0, 2, 1))


def _einsum(b: Builder, x: Val, columns: int) -> Val:
    letters = "abcdefg"[: x.rank - 1]
    flip = b.chance(0.5)
    shape = (columns, x.width) if flip else (x.width, columns)
    equation = f"{letters}k,{'nk' if flip else 'kn'}->{letters}n"
    weight = b.weight(shape, x.width**-0.5)
    made = b.op("Einsum", [x, weight], (*x.shape[:-1], columns), {"equation": equation})
    return _biased(b, made)


def one_layer(b: Builder) -> None:
    """A layer, perhaps with an activation behind it."""
    made = layer(b, b.rows())
    sp.at_times(b, 0.5, made)


def layers_in_a_row(b: Builder) -> None:
    """Layers on layers, at times with a factor or a residual between."""
    x = b.rows()
    for _ in range(b.rng.randint(2, 3)):
        before, x = x, layer(b, x, b.rng.choice((None, x.width)))
        if x.shape == before.shape and b.chance(0.3):
            x = sp.binary(b, b.rng.choice(("Add", "Sub", "Mul")), x, before)
        if b.chance(0.3):
            factor = sp.scalar(b, b.rng.choice((0.5, -2.0, 3.0, 0.1)))
            if factor.rank <= x.rank:
                x = sp.binary(b, b.rng.choice(("Mul", "Div")), x, factor)


def on_positions(b: Builder) -> None:
    """A layer on a value plus a layer of positions and a constant."""
    x = b.rows(2, 4)
    narrow = b.rng.choice((1, 2, 3))
    lead = list(x.shape[:-1])
    for axis in range(len(lead)):
        if b.chance(0.3):
            lead[axis] = 1
    first = b.rng.randint(0, len(lead) - 1) if b.chance(0.3) else 0
    positions = b.input([*lead[first:], narrow]) if first < len(lead) else x
    wide = sp.matmul(b, positions, b.weight((narrow, x.width)))
    if b.chance(0.7):
        wide = sp.binary(b, "Add", wide, b.weight((x.width,), 0.5))
    kind = b.rng.choice(("Add", "Add", "Sub"))
    both = sp.either_way(b, kind, x, wide)
    layer(b, both)
    if b.chance(0.3):
        layer(b, both)


def on_points(b: Builder) -> None:
    """A matrix for each camera times the vectors of all points; one may be repeated."""
    cameras, points = b.rng.choice((1, 3)), b.rng.choice((4, 60, 200))
    size, columns = b.rng.choice((3, 4)), b.rng.choice((1, 1, 2))
    matrices = b.input([cameras, 1, size, size])
    if b.chance(0.3):
        matrices = sp.tile(b, matrices, (1, points, 1, 1))
    elif b.chance(0.3):
        matrices = sp.unsqueeze(b, matrices, 0)
    vectors = b.input([1, points, size, columns])
    if b.chance(0.3):
        vectors = sp.expand(b, vectors, (cameras, points, size, columns))
    sp.matmul(b, matrices, vectors)


def on_columns(b: Builder) -> None:
    """A layer on columns side by side, some of them repeated or constant."""
    x = b.rows(2, 3)
    parts = [x]
    for _ in range(b.rng.randint(1, 2)):
        width = b.rng.choice((1, 2, 4, 8))
        kind = b.rng.random()
        if kind < 0.3 and is_static(x.shape):
            lead = [size for size in x.shape[:-1] if isinstance(size, int)]
            parts.append(b.const(b.normal((*lead, width))))
        elif kind < 0.6:
            small = b.input([*([1] * (x.rank - 1)), width])
            lead = [size if isinstance(size, int) else 1 for size in x.shape[:-1]]
            if is_static(x.shape):
                parts.append(sp.expand(b, small, (*lead, width)))
        elif kind < 0.8:
            parts.append(sp.matmul(b, x, b.weight((x.width, width))))
        else:
            parts.append(x)
    b.rng.shuffle(parts)
    layer(b, sp.concat(b, parts, x.rank - 1))


def same_source(b: Builder) -> None:
    """Several layers that read one value: queries, keys and values."""
    x = b.rows(2, 3)
    made = [layer(b, x) for _ in range(b.rng.randint(2, 4))]
    sp.at_times(b, 0.3, made[0])
    if made[0].shape == made[1].shape and b.chance(0.5):
        sp.binary(b, "Add", made[0], made[1])
