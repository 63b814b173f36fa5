"""What of measured or imported ranges deserves a look, and what to record instead."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from me2e_compress.base.display import plural
from me2e_compress.calibration.ranges import OUTLIER_CREST, Activity, Ranges

# Crest factor from which half an int8 step (range / 254) exceeds the root mean square,
# so that most elements round to zero
ROUND_CREST = 254

# Fewest scenes of a recording that nothing is said of. At the tag `road-1`, 4 of 16
# scenes miss more than a fifth of the range of 9 % of the driver's tensors, 8 of 3 %,
# one of 35 % (benchmarks/measure/observers.py).
FEW_SCENES = 8

NOT_FINITE = "Runtimes answer it each in their own way: guard what makes it"

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
        findings.append(RangeFinding("not finite", "warning", text, advice=NOT_FINITE))
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
