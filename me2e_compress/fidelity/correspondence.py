"""Which values of two graphs should be equal, and how far they are apart.

A value of one graph is held against the value of that name in the other. Passes and
other tools rename values and move them, so one without a namesake, or whose namesake is
another thing now, is looked for among all values of the other graph by its sketch.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Set

import numpy as np
import onnx_ir as ir

from me2e_compress.fidelity.sketches import PROJECTIONS, Sketches, gap
from me2e_compress.fidelity.values import Values
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, reads_of
from me2e_compress.graph.provenance import read
from me2e_compress.graph.shapes import static_shape

LINEAR = frozenset(
    {
        *("Add", "Concat", "Div", "Expand", "Gather", "Mul", "Neg", "Slice"),
        *("Split", "Sub"),
    }
)
"""Operators that a factor passes through, besides those that move elements."""


@dataclasses.dataclass(frozen=True)
class Held:
    """A value that was held against one of the other graph.

    Attributes:
        partner: the other value's name.
        gap: noise over signal, as :func:`me2e_compress.fidelity.sketches.gap` has it.
        worst: the frame with the largest one.
    """

    partner: str
    gap: float
    worst: int = 0


def held_as(partner: str, a: Sketches, b: Sketches) -> Held:
    """Hold one value's sketches, [frames, 33], against another's."""
    by_frame = [float(gap(x[None], y[None])) for x, y in zip(a, b, strict=True)]
    return Held(partner, float(gap(a, b)), int(np.argmax(by_frame)))


def hold(a: Values, b: Values, tolerance: float) -> dict[ir.Value, Held]:
    """Hold the values of a second graph against those of the first.

    What has no namesake and equals nothing is left out: it is not known what it should
    be. Both graphs must have run.
    """
    found, moved = dict[ir.Value, Held](), set[ir.Value]()
    sizes = _by_size(a)
    order = {node.name: at for at, node in enumerate(a.model.graph)}
    for name, value in b.by_name.items():
        own = _namesake(a, b, name)
        if own is not None and own.gap <= tolerance:
            found[value] = own
            continue
        # renamed, or no longer what it was called
        equal = _equal(a, b, name, sizes, tolerance)
        if _is_moved(a, b, value, order, moved, tolerance):
            moved.add(value)
            own = None
        if own is None and equal is not None:
            found[value] = equal
        elif own is not None and (equal is None or value.is_graph_output()):
            found[value] = own
        elif own is not None and equal is not None:
            roles = _roles(a, b, value, equal.partner)
            if roles:
                found[value] = own if name in roles else equal
    return found


def _namesake(a: Values, b: Values, name: str) -> Held | None:
    if name not in a.by_name:
        return None
    shapes = [static_shape(each.by_name[name]) for each in (a, b)]
    if None not in shapes and shapes[0] != shapes[1]:
        return Held(name, float("inf"))
    return held_as(name, a.sketch_of(name), b.sketch_of(name))


def _is_moved(
    a: Values,
    b: Values,
    value: ir.Value,
    order: Mapping[str | None, int],
    moved: Set[ir.Value],
    tolerance: float,
) -> bool:
    """Return whether a value has the name of another one by a pass's work.

    Its node says that it does the work of a node that comes later in the first graph,
    as one whose weights took in a factor; or a factor passes through its node from such
    a value, or it is a multiple of its namesake still.
    """
    node, name = value.producer(), str(value.name)
    if node is None or value.is_graph_output():
        return False
    passes_on = not moved.isdisjoint(node.inputs)
    maker = None if name not in a.by_name else a.by_name[name].producer()
    if maker is not None:
        past = read(node)
        origins = () if past is None else past.origins
        latest = max((order.get(each, -1) for each in origins), default=-1)
        if latest > order[maker.name]:
            return True
    if passes_on and node.op_type in LAYOUT_OPERATORS | LINEAR:
        return True
    if not passes_on or maker is None:
        return False
    x, y = (each.sketch_of(name)[..., :PROJECTIONS] for each in (a, b))
    factor = np.vdot(x, y) / (np.vdot(x, x) or 1.0)
    off = np.square(y - factor * x).sum()
    return bool(factor and off <= tolerance**2 * np.square(y).sum())


def _by_size(values: Values) -> dict[int | None, tuple[list[str], Sketches]]:
    """Group the watched values by their number of elements, None where it is open."""
    names: dict[int | None, list[str]] = {}
    for name in values.watched:
        names.setdefault(_size(values.by_name[name]), []).append(name)
    return {
        size: (each, np.stack([values.sketch_of(name) for name in each], axis=1))
        for size, each in names.items()
    }


def _size(value: ir.Value) -> int | None:
    shape = static_shape(value)
    return None if shape is None else int(np.prod(shape))


def _equal(
    a: Values,
    b: Values,
    name: str,
    sizes: Mapping[int | None, tuple[list[str], Sketches]],
    tolerance: float,
) -> Held | None:
    """Find the value of the first graph that one of the second equals.

    Zeros equal too much to say anything.
    """
    mine = b.sketch_of(name)
    names, others = sizes.get(_size(b.by_name[name]), ([], mine))
    if not names or not mine[:, -1].any():
        return None
    gaps = gap(others, mine[:, None])
    best = int(np.argmin(gaps))
    return Held(names[best], float(gaps[best])) if gaps[best] <= tolerance else None


def _roles(a: Values, b: Values, value: ir.Value, equal: str) -> set[str]:
    """Tell which values of the first graph one stands for that equals no namesake.

    Its readers are followed to what they give in both graphs; that, followed back in
    the first graph, comes to the namesake there, or to what this one equals. Values
    that only the first graph has are passed by: other nodes compute them as well.
    """
    roles, seen = set[str](), set[str]()
    waiting = list(_given(a, value))
    while waiting:
        there = a.by_name[waiting.pop()]
        node = there.producer()
        for each in () if node is None else reads_of(node):
            name = each.name or ""
            if name == value.name or a.source.get(name) == equal:
                roles.add(name if name == value.name else equal)
            elif name in a.by_name and name not in b.by_name and name not in seen:
                seen.add(name)
                waiting.append(name)
    return roles


def _given(a: Values, value: ir.Value) -> Iterator[str]:
    """Yield the first values behind one that the other graph has too, by name."""
    waiting, seen = [value], {value}
    while waiting:
        for reader in waiting.pop().consumers():
            for out in reader.outputs:
                if out.name in a.by_name:
                    yield out.name
                elif out not in seen:
                    seen.add(out)
                    waiting.append(out)
