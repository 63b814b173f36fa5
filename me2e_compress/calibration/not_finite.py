"""NaN and infinities of a calibration: where they show, and who made them first."""

from collections.abc import Mapping, Sequence, Set

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.calibration.statistics import Floats, no_element
from me2e_compress.display import counted
from me2e_compress.errors import FramesError
from me2e_compress.graph.nodes import FLOATS, grid_of, reads_of
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.probing import READINGS, Probe, insert_probes
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session


def places_of(model: ir.Model) -> list[str]:
    """Name the computed floats that say where to read: what is read shows no NaN."""
    found = dict[str, None]()
    for node in model.graph:
        value = grid_of(node)
        if node.op_type == "Cast" and node.outputs[0].dtype in _INDICES:
            value = node.inputs[0]
        if value is not None and value.producer() and value.dtype in FLOATS:
            found[str(value.name)] = None
    return list(found)


_INDICES = (ir.DataType.INT32, ir.DataType.INT64)


def first_maker(
    model: ir.Model,
    inputs: Mapping[str, Array],
    read: Set[str],
    probe: Probe,
    provider: Provider,
) -> str:
    """Name the node that first makes NaN or infinity of one frame, in a sentence.

    What ends before one of the tensors ``read``, such as a mask of -infinity before a
    Softmax, is no cause. ``probe`` takes extremes and mean squares.
    """
    made = [value for node in model.graph for value in node.outputs]
    floats = [str(value.name) for value in made if value.dtype in FLOATS]
    probed = insert_probes(model, floats, probe)
    session = Session(probed, optimize=False, provider=provider)
    readings = session.run(inputs, [READINGS])[READINGS].astype(np.float32)
    bad = are_bad(readings.reshape(len(floats), -1))
    names = {name for name, each in zip(floats, bad, strict=True) if each}
    ends = {*read} & names
    for node in reversed(model.graph):
        if any(value.name in ends for value in node.outputs):
            ends |= {str(each.name) for each in reads_of(node)} & names
    for value in made:
        if value.name in ends and (first := value.producer()) is not None:
            return (
                f"{first.name or value.name} ({first.op_type}) is first to make NaN or"
                f" infinity, in {value.name}; {counted(len(ends) - 1, 'tensor')} behind"
                " it"
            )
    return ""


def are_bad(readings: Floats) -> npt.NDArray[np.bool_]:
    """Tell which tensors hold NaN or infinity; mean squares may overflow."""
    bad = np.isnan(readings).any(1) | np.isinf(readings[:, :2]).any(1)
    return np.asarray(bad & ~no_element(readings))


def check_finite(
    readings: Floats, tensors: Sequence[str], place: int, cause: str = ""
) -> None:
    """Raise a FramesError for a NaN or infinite element, whose ``cause`` is told."""
    bad = are_bad(readings)
    if not bad.any():
        return
    # Name the first tensor, and how many more there are.
    names = [tensors[at] for at in np.flatnonzero(bad).tolist()]
    kind = "NaN" if np.isnan(readings[bad][0]).any() else "infinite"
    more = f" ({', '.join(names[1:5])}{', ...' if len(names) > 5 else ''})"
    raise FramesError(
        f"frame {place} makes tensor {names[0]} {kind}, and {len(names) - 1} more of"
        f" {len(tensors)}{more if len(names) > 1 else ''}: no range can be read from it"
        f"{cause and f'; {cause}'}"
    )
