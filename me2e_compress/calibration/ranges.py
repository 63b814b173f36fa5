"""Ranges of tensors, with the graph and frames they were measured on."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, Self, TypeAlias

import numpy as np
import pydantic

from me2e_compress.base import documents
from me2e_compress.base.atomic import write_document
from me2e_compress.base.display import join_names, plural
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.observers import OBSERVERS, Observer
from me2e_compress.calibration.statistics import ALL_ZERO, NOT_FINITE, Statistics

# Crest factor (largest magnitude of the range over root mean square) from which a
# tensor is reported: its int8 step then exceeds half its root mean square, so that most
# elements round to 0, 1 or 2 steps.
OUTLIER_CREST = 64

# The largest bound of a range: elements are float32.
LARGEST = float(np.finfo(np.float32).max)

# Method of ranges measured by another tool, on unknown frames
IMPORTED = "imported"


# What an input or output did over a recording: its values differed between frames, were
# the same in all, were zero in all, or had a NaN or infinity.
Activity: TypeAlias = Literal["varies", "constant", "zero", "not finite"]


@dataclasses.dataclass(frozen=True, repr=False)
class Ranges:
    """The range of every calibrated tensor.

    Attributes:
        tensors: (low, high) bounds by tensor name.
        method: observer with options: ``max-min``, ``percentile:99.9``.
        frames: number of frames; 0 for imported ranges.
        model: digest of the graph.
        source: fingerprint of the recording.
        rms: root mean square of tensors over all frames; empty where it is not known.
        scenes: number of scenes; None where it is not known.
        inputs: what each input of the graph did; empty where it is not known.
        outputs: what each output of the graph did; empty where it is not known.
        not_finite: the node that is first to make NaN or infinity, in a sentence; else
            empty, and not written.
    """

    tensors: dict[str, tuple[float, float]]
    method: str
    frames: int
    model: str
    source: str
    rms: dict[str, float] = dataclasses.field(default_factory=dict)
    scenes: int | None = None
    inputs: dict[str, Activity] = dataclasses.field(default_factory=dict)
    outputs: dict[str, Activity] = dataclasses.field(default_factory=dict)
    not_finite: str = ""

    @classmethod
    def of(cls, statistics: Statistics, method: Observer) -> Self:
        """Compute ranges from the statistics of a calibration."""
        lows, highs = method.ranges(statistics)
        bounds = zip(lows.tolist(), highs.tolist(), strict=True)
        return cls(
            dict(zip(statistics.tensors, bounds, strict=True)),
            OBSERVERS.text(method, defaults=True),
            len(statistics.frames),
            statistics.model,
            statistics.source,
            rms=rms_of(statistics),
            scenes=len(statistics.scenes) or None,
            inputs=_activities_of(statistics, statistics.inputs, 0),
            outputs=_activities_of(
                statistics, statistics.outputs, len(statistics.inputs)
            ),
            not_finite=statistics.not_finite,
        )

    @property
    def headline(self) -> str:
        """The number of tensors, the method and the number of frames."""
        return (
            f"{plural(len(self.tensors), 'tensor')}, {self.method},"
            f" {plural(self.frames, 'frame')}"
        )

    @property
    def dead(self) -> tuple[str, ...]:
        """The tensors that were zero in every frame, not those that a method cut."""
        zero = [name for name, bounds in self.tensors.items() if bounds == (0.0, 0.0)]
        return tuple(name for name in zero if not self.rms.get(name))

    @property
    def crests(self) -> dict[str, float]:
        """The largest magnitude of each range over its root mean square, if known."""
        ratios = {}
        for name, root in self.rms.items():
            low, high = self.tensors[name]
            ratios[name] = max(-low, high) / root if root else 0.0
        return ratios

    @property
    def outliers(self) -> dict[str, float]:
        """Crest factors, to three digits, of tensors whose range few elements make."""
        return {
            name: float(f"{crest:.3g}")
            for name, crest in self.crests.items()
            if crest > OUTLIER_CREST
        }

    def save(self, path: Path) -> None:
        """Write JSON atomically."""
        document = dataclasses.asdict(self)
        if not self.not_finite:
            del document["not_finite"]
        write_document(path, document, indent=1)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote; a FramesError if it contradicts itself."""
        if not path.is_file():
            raise FramesError(f"{path}: no such ranges file")
        with documents.reading(path, FramesError, "not ranges"):
            ranges = pydantic.TypeAdapter(cls).validate_json(documents.read_bytes(path))
        # Bounds must be finite and in order.
        for name, (low, high) in ranges.tensors.items():
            if not -LARGEST <= low <= high <= LARGEST:  # NaN too
                raise FramesError(
                    f"{path}: not ranges: {name} has {low:g} to {high:g}; a range is"
                    " two float32 bounds, the lower one first"
                )
        if lie := ranges._why_invalid():
            raise FramesError(f"{path}: not ranges: {lie}")
        return ranges

    def _why_invalid(self) -> str:
        """Return what in a file cannot be true; empty if all can."""
        imported = self.method == IMPORTED
        if self.frames < 1 and not imported:
            return f"{self.method} of {self.frames} frames; give a recording"
        if self.scenes is not None and not 0 < self.scenes <= self.frames:
            return f"{self.scenes} scenes in {self.frames} frames"
        for name, root in self.rms.items():
            if name not in self.tensors:
                return f"the root mean square of {name}, which has no range"
            if not 0 <= root <= LARGEST:  # NaN too
                return f"{name} has a root mean square of {root:g}"
        return ""

    def hold_for(self, model: str, tensors: tuple[str, ...], method: str) -> bool:
        """Return whether they fit this graph and method and have all these tensors."""
        asked = OBSERVERS.text(OBSERVERS.parse(method), defaults=True)
        known = self.model == model and self.method == asked
        return known and all(name in self.tensors for name in tensors)

    def check(
        self,
        *,
        model: str,
        tensors: tuple[str, ...],
        method: str,
        source: str | None = None,
        named: str | Path = "ranges",
    ) -> None:
        """Check that ranges fit this graph, tensor list, method and recording.

        ``model`` is the digest of the graph to be quantized, ``source`` the fingerprint
        of the frames, None if there are none; the message calls the ranges ``named``.
        Ranges that do not fit are a FramesError that says what to do.
        """
        again = "calibrate the graph that is being quantized again"
        if self.model != model:
            raise FramesError(
                f"{named}: stale: of graph {self.model[:12]}, not {model[:12]}; {again}"
            )
        # Imported ranges pass for any method and recording.
        asked = method
        if not method == self.method == IMPORTED:
            asked = OBSERVERS.text(OBSERVERS.parse(method), defaults=True)
        if self.method not in (asked, IMPORTED):
            raise FramesError(
                f"{named}: of method {self.method}, asked for {asked}; give --method"
            )
        wanted = self.source if source is None else source
        if self.method != IMPORTED and self.source != wanted:
            raise FramesError(
                f"{named}: stale: of frames {self.source[:12]}, not {wanted[:12]};"
                f" {again}"
            )
        # The graph may need tensors that were not measured.
        if missing := [name for name in tensors if name not in self.tensors]:
            if self.method == IMPORTED:
                again = "give the overrides that stand beside it (--overrides)"
            raise FramesError(
                f"{named}: of {len(tensors)} tensors lacks {join_names(missing, 1)};"
                f" {again}"
            )


def rms_of(statistics: Statistics) -> dict[str, float]:
    """Return root mean squares, to four digits; a square may be beyond float32."""
    if not statistics.tensors:
        return {}
    root = np.sqrt(statistics.mean_squares.astype(np.float64).mean(axis=0))
    pairs = zip(statistics.tensors, root.tolist(), strict=True)
    return {name: float(f"{rms:.4g}") for name, rms in pairs if math.isfinite(rms)}


def _activities_of(
    statistics: Statistics, names: Sequence[str], begin: int
) -> dict[str, Activity]:
    """Return what inputs or outputs did, from their checksums from column ``begin``."""
    activities = dict[str, Activity]()
    for name, column in zip(names, statistics.checksums.T[begin:], strict=False):
        if (column == NOT_FINITE).any():
            activities[name] = "not finite"
        elif (column != column[0]).any():
            activities[name] = "varies"
        else:
            activities[name] = "zero" if column[0] == ALL_ZERO else "constant"
    return activities


# What deserves a look in ranges.


# Crest factor from which half an int8 step (range / 254) exceeds the root mean square,
# so that most elements round to zero
ROUND_CREST = 254

# Fewest scenes of a recording that nothing is said of. At the tag `road-1`, 4 of 16
# scenes miss more than a fifth of the range of 9 % of the driver's tensors, 8 of 3 %,
# one of 35 % (benchmarks/measure/observers.py).
FEW_SCENES = 8

GUARD_ADVICE = "Runtimes answer it each in their own way: guard what makes it"

# Number of tensors that a line lists
_MOST_NAMES = 5

Kind = Literal[
    "rounds to zero", "few elements", "clipped", "dead tensor", "unfed input",
    "constant input", "dead output", "not finite", "few scenes", "not in cache",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class RangeFinding:
    """Something about ranges that deserves a look.

    Attributes:
        kind: what it is.
        severity: a ``warning`` is wrong for all that is known, a ``note`` may be meant.
        said: what it is, in words.
        names: tensors, inputs or outputs, the worst first.
        ratios: how far off each is; empty where nothing is compared.
        advice: what to record or do instead.
    """

    kind: Kind
    severity: Literal["warning", "note"]
    said: str
    names: tuple[str, ...] = ()
    ratios: tuple[float, ...] = ()
    advice: str = ""

    def __str__(self) -> str:
        """Write one line, with the worst names."""
        shown = list(self.names[:_MOST_NAMES])
        if self.ratios:
            pairs = zip(shown, self.ratios, strict=False)
            shown = [f"{name} ({ratio:.3g})" for name, ratio in pairs]
        more = len(self.names) - len(shown)
        names = "; ".join(shown) + (f"; and {more} more" if more > 0 else "")
        return ": ".join(filter(None, [self.said, names])) + (
            f". {self.advice}" if self.advice else ""
        )


def review(ranges: Ranges) -> tuple[RangeFinding, ...]:
    """Return findings on ranges, of their own values alone; warnings first."""

    def of_kind(activities: Mapping[str, Activity], kind: Activity) -> dict[str, None]:
        return dict.fromkeys(name for name, did in activities.items() if did == kind)

    # Tensors: the range of each over its root mean square, the worst first
    crests = sorted(ranges.crests.items(), key=lambda item: -item[1])
    findings = [
        *_name_finding(
            "rounds to zero",
            "warning",
            f"range of {ROUND_CREST} or more times the root mean square, where most"
            " elements round to zero",
            {name: crest for name, crest in crests if crest >= ROUND_CREST},
            "Look for a frame in other units or with a wrong number type; else clip by"
            " --method, or keep the readers float",
        ),
        *_name_finding(
            "few elements",
            "note",
            f"range of over {OUTLIER_CREST} times the root mean square, which a few"
            " elements make",
            {n: crest for n, crest in crests if OUTLIER_CREST < crest < ROUND_CREST},
        ),
        *_name_finding(
            "clipped",
            "warning",
            "range below the root mean square, which cuts most of the signal",
            {n: crest for n, crest in reversed(crests) if ranges.rms[n] and crest < 1},
            "These ranges are of other frames or units, or the method clips too much:"
            " calibrate again, by max-min",
        ),
        *_name_finding(
            "dead tensor",
            "note",
            "tensor always zero",
            dict.fromkeys(ranges.dead),
            "Nothing is known of them: record frames in which they are used (agents in"
            " view, a state that is fed, other commands)",
        ),
        # Inputs and outputs: one frame does not tell what changes
        *_name_finding(
            "unfed input",
            "warning",
            "input zero in every frame",
            of_kind(ranges.inputs, "zero"),
            "A state or history of zeros gives ranges that no second frame fits: record"
            " scenes of frames in a row, and let `inspect` show what is fed back"
            " (--adapter)",
        ),
        *_name_finding(
            "constant input",
            "note",
            "input the same in every frame",
            of_kind(ranges.inputs, "constant") if ranges.frames > 1 else {},
            "The ranges hold for these values alone: record other commands and speeds;"
            " camera matrices of one vehicle fit that vehicle only",
        ),
        *_name_finding(
            "not finite",
            "warning",
            "output with NaN or infinity",
            of_kind(ranges.outputs, "not finite"),
            "Find the frame by `compare M.onnx M.onnx FRAMES`, and leave it out",
        ),
        *_name_finding(
            "dead output",
            "warning",
            "output the same in every frame",
            of_kind(ranges.outputs, "zero")
            | (of_kind(ranges.outputs, "constant") if ranges.frames > 1 else {}),
            "What makes them was not exercised: record frames in which they answer",
        ),
    ]
    # The whole recording
    if text := ranges.not_finite:
        findings.append(
            RangeFinding("not finite", "warning", text, advice=GUARD_ADVICE)
        )
    if ranges.scenes is not None and ranges.scenes < FEW_SCENES:
        text = f"{plural(ranges.frames, 'frame')} in {plural(ranges.scenes, 'scene')}"
        advice = (
            f"Frames of one scene look alike: record {FEW_SCENES} scenes or more, on"
            " other routes, in other traffic and light"
        )
        findings.append(RangeFinding("few scenes", "note", text, advice=advice))
    return tuple(sorted(findings, key=lambda finding: finding.severity, reverse=True))


def missing_ranges(cache: Path, missing: Sequence[str]) -> tuple[RangeFinding, ...]:
    """Return a finding on the tensors that an imported cache lacks, if any."""
    if not missing:
        return ()
    text = f"{plural(len(missing), 'tensor')} not in {cache}"
    advice = "What reads them stays float, as in TensorRT 10"
    return (
        RangeFinding("not in cache", "warning", text, tuple(missing), advice=advice),
    )


def _name_finding(
    kind: Kind,
    severity: Literal["warning", "note"],
    text: str,
    ratio_of: Mapping[str, float | None],
    advice: str = "",
) -> Iterable[RangeFinding]:
    """Yield a finding on the names, if any; ``text`` begins with the noun to count."""
    if ratio_of:
        noun, rest = text.split(" ", 1)
        ratios = tuple(ratio for ratio in ratio_of.values() if ratio is not None)
        line = f"{plural(len(ratio_of), noun)} {rest}"
        yield RangeFinding(kind, severity, line, tuple(ratio_of), ratios, advice)
