"""Statistics of every tensor on every frame, and the probes that read them."""

import dataclasses
import functools
import zlib
from collections.abc import Mapping, Sequence, Set
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.base.display import join_names, plural
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.graph import rewrite
from me2e_compress.graph.nodes import FLOATS, grid_of, reads_of
from me2e_compress.operators.kernels.kernel import BINS, LEAST_EXPONENT
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session

# Checksums of an array of zeros, and of one with NaN or infinity
ALL_ZERO, NOT_FINITE = 0, -1

Floats: TypeAlias = npt.NDArray[np.float32]


# Probes: nodes added to a graph that measure its tensors as they are computed. Each
# follows right after the node that makes its tensor, so that the tensor is freed as
# early as without it; all readings are one more output.


READINGS = "me2e_readings"
"""Name of the output that the probes write: float32 [tensors x width of the probe]."""

# Nodes that measure a tensor, in order, and the 1-D values that they produce
Reading: TypeAlias = tuple[list[ir.Node], list[ir.Value]]


class Probe(Protocol):
    """Measures tensors by nodes inserted after them."""

    @property
    def width(self) -> int:
        """Number of values read per tensor."""
        ...

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Return the nodes that measure a float32 value, the ``at``-th watched one."""
        ...


def insert_probes(model: ir.Model, tensors: Sequence[str], probe: Probe) -> ir.Model:
    """Return a copy of a graph with a probe after each tensor, and their one output."""
    copy = model.clone()
    made = (value for node in copy.graph for value in node.outputs)
    known = {str(value.name): value for value in (*copy.graph.inputs, *made)}
    if missing := [name for name in tensors if name not in known]:
        raise GraphError(f"the graph has no tensor {missing[0]}")
    # Measure each tensor right after its producer.
    readings = [
        reading
        for at, name in enumerate(tensors)
        for reading in _probe_tensor(copy.graph, known[name], probe, at)
    ]
    # Join all readings into one output.
    joined = ir.node("Concat", readings, {"axis": 0}, name=READINGS)
    joined.outputs[0].name = READINGS
    joined.outputs[0].dtype = ir.DataType.FLOAT
    joined.outputs[0].shape = ir.Shape([len(tensors) * probe.width])
    copy.graph.append(joined)
    copy.graph.outputs.append(joined.outputs[0])
    return copy


def _probe_tensor(
    where: ir.Graph, value: ir.Value, probe: Probe, at: int
) -> Sequence[ir.Value]:
    """Insert the nodes that measure one tensor; return its 1-D readings."""
    nodes: list[ir.Node] = []
    measured = value
    if value.dtype not in (None, ir.DataType.FLOAT):
        nodes.append(ir.node("Cast", [value], {"to": ir.DataType.FLOAT.value}))
        measured = nodes[0].outputs[0]
        measured.shape, measured.dtype = value.shape, ir.DataType.FLOAT
    # Names tell which tensor a probe measures.
    measuring, readings = probe.read(where, measured, at)
    nodes += measuring
    for order, node in enumerate(nodes):
        node.name = f"{READINGS}/{value.name}/{order}_{node.op_type}"
        node.outputs[0].name = node.name
    # A graph input is measured before anything else runs.
    producer = value.producer()
    if producer is not None:
        where.insert_after(producer, nodes)
    elif len(where):
        where.insert_before(where[0], nodes)
    return readings


def shared_constant(
    where: ir.Graph, array: npt.NDArray[np.generic], name: str
) -> ir.Value:
    """Return a constant of the probes, created at its first use."""
    name = f"me2e_probe_{name}"
    known = where.initializers.get(name)
    if known is not None:
        return known
    return rewrite.add_constant(where, array, name, names=set())


@dataclasses.dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of a calibration.

    Attributes:
        source: fingerprint of the recording.
        frames: indices of the frames in the recording.
        measured: float32 [frames, tensors, 3]: smallest and largest element, mean
            square; infinity, minus infinity and 0 where a tensor had no element.
        counts: int64 [tensors, bins] over all frames: how many magnitudes lie in each
            bin of [0, 2^exponent); None without histograms.
        inputs: names of the graph's inputs.
        outputs: names of the graph's outputs.
        checksums: int64 [frames, inputs + outputs]: :func:`checksum` of what each was.
        scenes: indices of the frames that begin a scene.
        not_finite: the node that is first to make NaN or infinity, in a sentence; else
            empty.
    """

    model: str
    source: str
    tensors: tuple[str, ...]
    frames: tuple[int, ...]
    measured: Floats
    counts: npt.NDArray[np.int64] | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    checksums: npt.NDArray[np.int64] = dataclasses.field(
        default_factory=lambda: np.empty((0, 0), np.int64)
    )
    scenes: tuple[int, ...] = ()
    not_finite: str = ""

    @functools.cached_property
    def readings(self) -> Floats:
        """The measurements, filled in where a tensor had no element."""
        empty = is_empty(self.measured)
        if not empty.any():
            return self.measured
        rows = np.arange(len(self.frames))[:, None]
        # The value is that of the last frame with an element, else of the first such
        # frame; 0 if there is none
        last = np.maximum.accumulate(np.where(empty, -1, rows), axis=0)
        frame_of = np.where(last < 0, np.argmin(empty, axis=0), last)
        filled = self.measured[frame_of, np.arange(len(self.tensors))]
        return np.where(empty.all(axis=0, keepdims=True).T, np.float32(0), filled)

    @property
    def lows(self) -> Floats:
        """The smallest elements: float32 [frames, tensors]."""
        return self.readings[:, :, 0]

    @property
    def highs(self) -> Floats:
        """The largest elements: float32 [frames, tensors]."""
        return self.readings[:, :, 1]

    @property
    def mean_squares(self) -> Floats:
        """The mean squares: float32 [frames, tensors]."""
        return self.readings[:, :, 2]

    @property
    def reach(self) -> Floats:
        """The largest magnitudes over all frames: float32 [tensors]."""
        magnitudes = np.abs(self.readings[:, :, :2])
        return np.asarray(magnitudes.max(axis=(0, 2), initial=0), np.float32)

    @property
    def exponents(self) -> npt.NDArray[np.int64]:
        """The least e for which 2^e exceeds all magnitudes: int64 [tensors]."""
        exponents = exponents_of(self.measured)
        return np.asarray(exponents.max(axis=0, initial=LEAST_EXPONENT))

    def histograms(self) -> npt.NDArray[np.int64]:
        """Return the histograms; FramesError if none were collected."""
        if self.counts is None:
            raise FramesError(
                "these statistics hold no histograms: calibrate again with a method"
                " that needs them"
            )
        return self.counts


def exponents_of(measured: Floats) -> npt.NDArray[np.int64]:
    """Return the least e for which 2^e exceeds each reach: int64 [...] of [..., 3]."""
    reach = np.abs(measured[..., :2]).max(axis=-1)
    reach = np.where(is_empty(measured), np.float32(0), reach)
    return np.maximum(np.frexp(reach)[1], LEAST_EXPONENT).astype(np.int64)


def rebinned(
    counts: npt.NDArray[np.int64], octaves: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Return histograms over a range that is 2^octaves as wide, with as many bins.

    Each bin is the sum of 2^octaves bins of ``counts``, int64 [tensors, BINS];
    ``octaves`` is int64 [tensors], not negative.
    """
    merged = np.minimum(1 << np.minimum(octaves, 62), BINS)
    wider = np.zeros_like(counts)
    for width in np.unique(merged).tolist():
        rows = merged == width
        sums = counts[rows].reshape(-1, BINS // width, width).sum(axis=2)
        wider[rows, : BINS // width] = sums
    return wider


def checksum(array: Array) -> int:
    """Return a number that distinguishes arrays: the CRC-32 of the bytes, plus 1."""
    if not array.any():
        return ALL_ZERO
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return NOT_FINITE
    return zlib.crc32(np.ascontiguousarray(array).data.cast("B")) + 1


def is_empty(measured: Floats) -> npt.NDArray[np.bool_]:
    """Return which tensors had no element: bool [...], of readings float32 [..., 3]."""
    return np.asarray((measured[..., 0] == np.inf) & (measured[..., 1] == -np.inf))


# NaN and infinities: where they show, and who made them first.


def index_inputs(model: ir.Model) -> list[str]:
    """Name the computed floats that are positions to read at, which hide a NaN."""
    places = dict[str, None]()
    for node in model.graph:
        value = grid_of(node)
        if node.op_type == "Cast" and node.outputs[0].dtype in _INDICES:
            value = node.inputs[0]
        if value is not None and value.producer() and value.dtype in FLOATS:
            places[str(value.name)] = None
    return list(places)


_INDICES = (ir.DataType.INT32, ir.DataType.INT64)


def first_bad_node(
    model: ir.Model,
    inputs: Mapping[str, Array],
    read: Set[str],
    probe: Probe,
    provider: Provider,
) -> str:
    """Name the node that first makes NaN or infinity of one frame, in a sentence."""
    made = [value for node in model.graph for value in node.outputs]
    floats = [str(value.name) for value in made if value.dtype in FLOATS]

    def not_finite(tensors: Sequence[str]) -> set[str]:
        probed = insert_probes(model, tensors, probe)
        # Every tensor is freed as soon as it is read
        session = Session(probed, optimize=False, frugal=True, provider=provider)
        readings = session.run(inputs, [READINGS])[READINGS].astype(np.float32)
        bad = is_not_finite(readings.reshape(len(tensors), -1))
        return {name for name, is_bad in zip(tensors, bad, strict=True) if is_bad}

    # Only where something read is not finite, look at every tensor
    watched = [name for name in floats if name in read]
    if not watched or not not_finite(watched):
        return ""
    names = not_finite(floats)
    # NaN that reaches none of the tensors read is no cause, such as a mask of -infinity
    # before a Softmax
    ends = {*read} & names
    for node in reversed(model.graph):
        if any(value.name in ends for value in node.outputs):
            ends |= {str(value.name) for value in reads_of(node)} & names
    for value in made:
        if value.name in ends and (first := value.producer()) is not None:
            behind = f"; {plural(len(ends) - 1, 'tensor')} behind it"
            return (
                f"{first.name or value.name} ({first.op_type}) is first to make NaN or"
                f" infinity, in {value.name}{behind if len(ends) > 1 else ''}"
            )
    return ""


def is_not_finite(readings: Floats) -> npt.NDArray[np.bool_]:
    """Return which tensors hold NaN or infinity: bool [n], of readings [n, 3]."""
    # Mean squares may overflow to infinity
    bad = np.isnan(readings).any(1) | np.isinf(readings[:, :2]).any(1)
    return np.asarray(bad & ~is_empty(readings))


def check_finite(
    readings: Floats, tensors: Sequence[str], place: int, cause: str = ""
) -> None:
    """Raise a FramesError for a NaN or infinite element, whose ``cause`` is told."""
    bad = is_not_finite(readings)
    if not bad.any():
        return
    # Name the first tensor, and how many more there are.
    names = [tensors[at] for at in np.flatnonzero(bad).tolist()]
    kind = "NaN" if np.isnan(readings[bad][0]).any() else "infinite"
    more = f", and of {len(tensors)} {join_names(names[1:], 4)}"
    raise FramesError(
        f"frame {place} makes tensor {names[0]} {kind}{more if len(names) > 1 else ''}:"
        " no range can be read from it"
        f"{cause and f'; {cause}'}"
    )
