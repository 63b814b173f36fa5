"""Re-run only the part of a graph that a change can reach."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping
from typing import Self

import numpy as np
import onnx_ir as ir

from me2e_compress import graph, rewrite
from me2e_compress.fidelity.compare import Reference
from me2e_compress.graph.recurrence import RECURRENT
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import DTYPES, Session, replay
from me2e_compress.targets.quantized import PAIR


@dataclasses.dataclass(frozen=True, eq=False)
class Suffix:
    """The part of a float graph behind some of its nodes.

    ``boundary`` names the values that enter it and are computed before it, ``outputs``
    the graph's outputs that it computes; ``share`` is its share of the graph's MACs.
    """

    boundary: tuple[str, ...]
    outputs: tuple[str, ...]
    share: float

    @classmethod
    def behind(cls, model: ir.Model, names: Collection[str]) -> Self | None:
        """Find what the named nodes reach; None in a graph with subgraphs."""
        if any(True for _ in model.graph.subgraphs()):
            return None  # their bodies read values by name
        count, total, inside = graph.macs_counter(model), 0, 0
        reached, read = set[ir.Value](), dict[str, None]()
        for node in model.graph:
            macs = count(node) or 0
            total += macs
            inputs = [each for each in node.inputs if each is not None]
            if node.name not in names and not reached.intersection(inputs):
                continue
            inside += macs
            reached.update(node.outputs)
            before = (each for each in inputs if each not in reached)
            read |= {str(e.name): None for e in before if e.producer() is not None}
        outputs = [str(each.name) for each in model.graph.outputs if each in reached]
        return cls(tuple(read), tuple(outputs), inside / max(total, 1))

    def capture(self, model: ir.Model, reference: Reference) -> Reference:
        """Run the float graph once for the values at the boundary.

        Returns the reference's answers, with frames that hold the boundary too.
        """
        probe = model.clone()
        values = _values(probe)
        known = {str(each.name) for each in probe.graph.outputs}
        added = [values[name] for name in self.boundary if name not in known]
        probe.graph.outputs.extend(added)
        session = Session(probe, release=True, provider=reference.session.provider)
        found = replay(session, reference.frames, self.boundary)
        frames = (
            dataclasses.replace(
                frame, arrays={**_states(session), **frame.arrays, **entering}
            )
            for frame, entering in zip(reference.frames, found, strict=True)
        )
        return Reference(reference.session, tuple(frames), reference.answers)

    def cut(self, variant: ir.Model) -> ir.Model | None:
        """Cut the suffix out of a variant; None if it does not stand alone.

        That happens if int8 was put before the boundary too: on what a Concat joins.
        """
        # where the suffix begins in this variant
        part = variant.clone()
        values = _values(part)
        entering = [values[name] for name in self.boundary if name in values]
        if len(entering) < len(self.boundary) or _quantized(entering):
            return None
        # keep the suffix's outputs alone, and read the boundary from new inputs
        ports = [ir.Value(shape=e.shape, type=e.type) for e in entering]
        kept = [each for each in part.graph.outputs if each.name in self.outputs]
        part.graph.outputs.clear()
        part.graph.outputs.extend(kept)
        for old, new in zip(entering, ports, strict=True):
            old.replace_all_uses_with(new)
        rewrite.sweep(part)
        # the ports take the boundary's names once the old nodes are swept
        for name, port in zip(self.boundary, ports, strict=True):
            port.name = name
            part.graph.inputs.append(port)
        part.metadata_props.clear()
        part.metadata_props[RECURRENT] = "{}"  # states are inputs like others here
        return part


def _values(model: ir.Model) -> dict[str, ir.Value]:
    return {str(each.name): each for node in model.graph for each in node.outputs}


def _quantized(values: Iterable[ir.Value]) -> bool:
    """Return whether Q/DQ pairs compute any of these values."""
    left = [each.producer() for each in values]
    seen = set[ir.Node]()
    while left:
        node = left.pop()
        if node is None or node in seen:
            continue
        if node.op_type in PAIR:
            return True
        seen.add(node)
        left += [each.producer() for each in node.inputs if each is not None]
    return False


def _states(session: Session) -> Mapping[str, Array]:
    """Return zeros for every state of known shape."""
    ports = {name: session.inputs[name] for name in session.recurrent}
    return {
        name: np.zeros([each for each in port.shape if isinstance(each, int)], dtype)
        for name, port in ports.items()
        if (dtype := DTYPES.get(port.type)) is not None
        and all(isinstance(each, int) for each in port.shape)
    }
