"""Run places of a graph alone, on values that its source computed."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import onnx_ir as ir

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.fidelity.correspondence import Held
from me2e_compress.fidelity.places import Region
from me2e_compress.fidelity.sketches import apart
from me2e_compress.fidelity.values import Fed
from me2e_compress.graph.part import part_of
from me2e_compress.graph.shapes import static_shape
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session, detached

Arrays = Callable[[Iterable[str], int], Mapping[str, Array]]
"""Returns values by name in one frame: those that a place is run alone on."""


@dataclasses.dataclass(frozen=True)
class Truth:
    """Computes values of the source again, whole."""

    model: ir.Model
    fed: Fed
    provider: Provider

    def arrays(self, names: Iterable[str], frame: int) -> Mapping[str, Array]:
        """Return values by name in one frame."""
        wanted = [str(each.name) for each in self._made(names)]
        if not wanted:
            return {}
        part = part_of(self.model, self.model.graph.inputs, self._made(names))
        session = Session(part, optimize=False, release=True, provider=self.provider)
        return detached(session.run(self.fed[frame], wanted))

    def _made(self, names: Iterable[str]) -> list[ir.Value]:
        values = {out.name: out for node in self.model.graph for out in node.outputs}
        return [values[name] for name in dict.fromkeys(names)]


def own_gaps(
    model: ir.Model,
    batch: Sequence[Region],
    held: Mapping[ir.Value, Held],
    arrays: Arrays,
    fed: Fed,
    provider: Provider,
) -> list[float | None]:
    """Run places alone on right values; return how far each is off by itself.

    None where a place does not run alone.
    """
    own: dict[Region, float | None] = {}
    for frame in sorted({held[each.value].worst for each in batch}):
        here = [each for each in batch if held[each.value].worst == frame]
        names = [
            held[value].partner
            for each in here
            for value in (each.value, *each.reads)
            if value in held
        ]
        known = arrays(names, frame)
        for each in here:
            own[each] = _own_gap(model, each, held, known, fed[frame], provider)
    return [own[each] for each in batch]


def _own_gap(
    model: ir.Model,
    region: Region,
    held: Mapping[ir.Value, Held],
    known: Mapping[str, Array],
    fed: Mapping[str, Array],
    provider: Provider,
) -> float | None:
    feeds = {
        str(value.name): _fitting(known[held[value].partner], value)
        if value in held
        else fed[str(value.name)]
        for value in region.reads
    }
    try:
        part = part_of(model, region.reads, [region.value])
        got = Session(part, optimize=False, provider=provider).run(feeds)
    except (FramesError, GraphError, ValueError):
        return None
    return apart(known[held[region.value].partner], got[str(region.value.name)])


def _fitting(array: Array, value: ir.Value) -> Array:
    """Give an array the type and the shape of the value that it is read as."""
    shape = static_shape(value)
    if shape is not None and math.prod(shape) == array.size:
        array = array.reshape(shape)
    return array if value.dtype is None else array.astype(value.dtype.numpy())
