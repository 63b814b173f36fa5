"""Estimate where int8 costs more at its borders than it saves in arithmetic."""

import dataclasses
import itertools
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import TypeAlias

import onnx_ir as ir

Layers = frozenset[ir.Node]


@dataclasses.dataclass(frozen=True)
class Join:
    """An Add or Concat: it is in int8 if a layer before it and one behind it are.

    ``makers`` are the layers that its inputs come from, ``readers`` those that read its
    result.
    """

    makers: Layers
    readers: Layers


@dataclasses.dataclass(frozen=True)
class Border:
    """A tensor where int8 may begin or end.

    It is int8 if any of ``makers`` is. ``quantize_s`` is paid if no int8 layer makes
    it, ``dequantize_s`` for each that reads it in float if one does; ``float_readers``
    are those that are no layers or joins, and the graph where it is an output.
    """

    quantize_s: float
    dequantize_s: float
    makers: Layers = frozenset()
    readers: Layers = frozenset()
    joins: tuple[Join, ...] = ()
    float_readers: int = 0

    def layers(self) -> Iterator[ir.Node]:
        """Iterate over all layers whose int8 decides what it costs."""
        yield from self.makers
        yield from self.readers
        for join in self.joins:
            yield from join.makers
            yield from join.readers

    def paid_s(self, int8: Collection[ir.Node]) -> float:
        """Return its conversion seconds if exactly these layers are int8."""
        if not self.makers.isdisjoint(int8):
            readers = sum(layer not in int8 for layer in self.readers)
            joins = sum(join.readers.isdisjoint(int8) for join in self.joins)
            return (self.float_readers + readers + joins) * self.dequantize_s
        read = not self.readers.isdisjoint(int8) or any(
            not (join.makers.isdisjoint(int8) or join.readers.isdisjoint(int8))
            for join in self.joins
        )
        return self.quantize_s if read else 0.0


@dataclasses.dataclass(frozen=True)
class Loss:
    """Int8 that does not pay, for one layer or several together.

    ``saved_s`` are the seconds that the layers save in int8, usually negative or small;
    ``paid_s`` those that quantizing and dequantizing for them take.
    """

    saved_s: float
    paid_s: float
    layers: int = 1

    def __str__(self) -> str:
        whose = "" if self.layers == 1 else f" ({self.layers} layers together)"
        time, saves = f"{abs(self.saved_s) * 1e6:.1f} µs", self.saved_s >= 0
        borders = f"take {self.paid_s * 1e6:.1f} µs to quantize and dequantize"
        if self.paid_s < 0:
            borders = f"save {-self.paid_s * 1e6:.1f} µs of reading and writing"
        return (
            f"int8 would {f'save {time} of' if saves else f'add {time} to'} arithmetic"
            f" and {borders}{whose}"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Costs:
    """What int8 would save and cost in one graph on one machine.

    Layers with open shapes are not in ``saved_s`` (seconds, without borders), and are
    not judged. A loss below ``margin_s`` counts as none: the smaller file wins.
    """

    machine: str
    saved_s: Mapping[ir.Node, float]
    borders: tuple[Border, ...]
    margin_s: float = 1e-6

    def losses(self, int8: Iterable[ir.Node]) -> dict[ir.Node, Loss]:
        """Find the layers that are faster in float, among those that could be int8.

        First one by one: a layer goes if that saves time while all others stay; its
        neighbours are then looked at again. Then each connected int8 region goes if it
        does not pay as a whole. Not always the best choice, but near it, and linear.
        """
        kept, saved_s = dict.fromkeys(int8), self.saved_s
        touching: dict[ir.Node, list[Border]] = {layer: [] for layer in kept}
        for border in self.borders:
            for layer in dict.fromkeys(border.layers()):
                if layer in touching:
                    touching[layer].append(border)
        # one by one: a layer that goes changes its neighbours' costs, which queue again
        losses: dict[ir.Node, Loss] = {}
        waiting = deque(layer for layer in kept if layer in saved_s)
        while waiting:
            layer = waiting.popleft()
            if layer not in kept:
                continue
            before = sum(border.paid_s(kept) for border in touching[layer])
            del kept[layer]
            paid = before - sum(border.paid_s(kept) for border in touching[layer])
            if saved_s[layer] + self.margin_s >= paid:
                kept[layer] = None
                continue
            losses[layer] = Loss(saved_s[layer], paid)
            near = itertools.chain(*(border.layers() for border in touching[layer]))
            waiting += [n for n in dict.fromkeys(near) if n in saved_s]
        # region by region: what one pays at all its borders, and saves
        for island in _islands(kept, touching):
            if any(layer not in saved_s for layer in island):
                continue
            borders = dict.fromkeys(b for layer in island for b in touching[layer])
            paid = sum(border.paid_s(kept) for border in borders)
            saved = sum(saved_s[layer] for layer in island)
            if saved + self.margin_s < paid:
                losses.update(dict.fromkeys(island, Loss(saved, paid, len(island))))
        return losses


CostsOf: TypeAlias = Callable[[ir.Model, Collection[ir.Node]], Costs | None]
"""Estimates what a target's int8 of some layers would save and cost in a graph."""


def _islands(
    kept: Collection[ir.Node], touching: Mapping[ir.Node, list[Border]]
) -> Iterator[list[ir.Node]]:
    """Yield the layers that are joined by borders, directly or through others."""
    visited: set[ir.Node] = set()
    for first in kept:
        island, waiting = list[ir.Node](), [first]
        while waiting:
            layer = waiting.pop()
            if layer in visited or layer not in kept:
                continue
            visited.add(layer)
            island.append(layer)
            for border in touching[layer]:
                waiting += border.layers()
        if island:
            yield island
