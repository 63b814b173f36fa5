"""The measured energy of a model on one machine, or the reason why there is none."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Self, TypeAlias

import numpy as np
from pydantic import Field, TypeAdapter

from me2e_compress.display import Table, table
from me2e_compress.errors import EnergyError
from me2e_compress.registry import documents, drafts
from me2e_compress.runtime.atomic import write_document
from me2e_compress.runtime.energy.estimate import Window, estimate
from me2e_compress.runtime.energy.reader import DeviceState

Finite: TypeAlias = Annotated[float, Field(allow_inf_nan=False)]
NotNegative: TypeAlias = Annotated[float, Field(allow_inf_nan=False, ge=0)]
Positive: TypeAlias = Annotated[float, Field(allow_inf_nan=False, gt=0)]

FURTHEST_APART = 0.1
"""Relative difference between counter and integrated power that is tolerated; a known
bad case is 187 J beside 327 J (Zeus, issue 181)."""


@dataclass(frozen=True, repr=False)
class EnergyResult:
    """Energy per frame over windows of a counter; None means not measured.

    Frames run one at a time, back to back, as in MLPerf's SingleStream.

    Attributes:
        joules: of all windows; idle power included.
        frames: inferences in all windows.
        j_per_frame: idle power included; gross.
        net_j_per_frame: without idle power; noise may make it
            negative.
        low: 95 % interval of ``j_per_frame``. It covers repetition on
            this device and counter, not the error of the counter itself.
        high: likewise.
        windows: number of windows.
        window_s: mean seconds of a window.
        counter: ``nvml-total`` or another.
        counter_step_s: seconds between its updates.
        idle_w: watts of the idle device; with the model loaded, mean of before and
            after.
        temperature: degrees Celsius, before and after.
        clocks: lowest and highest MHz of each clock.
        throttled: why the device slowed itself down in a window.
        device: name of the device.
        scope: what the counter covers: a board, packages, rails.
        reason: why nothing was measured; empty if it was.
        model_sha256: digest of the model that ran; None if unknown.
        window_j_per_frame: joules per frame of each window.
        power_j_per_frame: by integrated power; beside the counter.
    """

    joules: NotNegative | None = None
    frames: Annotated[int, Field(ge=0)] = 0
    j_per_frame: Positive | None = None
    net_j_per_frame: Finite | None = None
    low: NotNegative | None = None
    high: Positive | None = None
    windows: Annotated[int, Field(ge=0)] = 0
    window_s: Positive | None = None
    counter: str | None = None
    counter_step_s: Positive | None = None
    idle_w: NotNegative | None = None
    temperature: tuple[Finite, Finite] | None = None
    clocks: Mapping[str, tuple[Finite, Finite]] = field(default_factory=dict)
    throttled: tuple[str, ...] = ()
    device: str = ""
    scope: str = ""
    reason: str = ""
    model_sha256: str | None = None
    window_j_per_frame: tuple[Finite, ...] = ()
    power_j_per_frame: NotNegative | None = None

    def __post_init__(self) -> None:
        """Check that there is either a figure with its interval, or a reason."""
        if self.j_per_frame is None:
            if not self.reason or self.joules is not None:
                raise ValueError("neither joules a frame nor a reason why not")
            return
        if self.reason:
            raise ValueError("both joules a frame and a reason why there are none")
        if self.low is None or self.high is None or self.joules is None:
            raise ValueError("joules, low and high go with j_per_frame")
        if not self.low <= self.j_per_frame <= self.high:
            raise ValueError("low to high does not hold j_per_frame")

    @property
    def headline(self) -> str:
        """The joules per frame with their interval, or why there are none."""
        if self.j_per_frame is None:
            return f"energy: not measured: {self.reason}"
        return (
            f"energy: {self.j_per_frame:.4g} J a frame"
            f" ({self.low:.4g} to {self.high:.4g}), {self.counter} of {self.device}"
        )

    @property
    def power_apart(self) -> float | None:
        """The relative difference of integrated power from the counter."""
        if self.j_per_frame is None or self.power_j_per_frame is None:
            return None
        return self.power_j_per_frame / self.j_per_frame - 1

    def alerts(self) -> tuple[str, ...]:
        """Return reasons to doubt the figure."""
        slowed = ", ".join(self.throttled)
        throttled = (f"energy: the device slowed itself down: {slowed}",)
        # A counter that disagrees with integrated power is suspect.
        apart = self.power_apart
        found = throttled if slowed else ()
        if apart is None or abs(apart) <= FURTHEST_APART:
            return found
        line = (
            f"energy: integrated power says {self.power_j_per_frame:.4g} J a frame,"
            f" {apart:+.0%} from the counter: one of them is wrong"
        )
        return (*found, line)

    def tables(self) -> tuple[Table, ...]:
        """Return the table of figures; empty if nothing was measured."""
        if self.j_per_frame is None:
            return ()
        rows = [
            ("gross", f"{self.j_per_frame:.4g}", f"{self.low:.4g}", f"{self.high:.4g}")
        ]
        if self.net_j_per_frame is not None:
            rows.append(("net of idle", f"{self.net_j_per_frame:.4g}", "", ""))
        if self.power_j_per_frame is not None:
            rows.append(("by power", f"{self.power_j_per_frame:.4g}", "", ""))
        columns = ("energy", "J/frame", "low 95 %", "high 95 %")
        title = f"{self.counter} of {self.device} ({self.scope})"
        return (table(title, columns, rows, "\n".join(self._notes())),)

    def _notes(self) -> list[str]:
        long = f" of {self.window_s:.1f} s" if self.window_s else ""
        notes = [f"{self.frames} frames in {self.windows} windows{long}"]
        if self.idle_w is not None:
            notes.append(f"idle {self.idle_w:.4g} W")
        if self.temperature is not None:
            notes.append("{:.0f} to {:.0f} °C".format(*self.temperature))
        notes += [
            f"{name} {low:.0f} to {high:.0f} MHz"
            for name, (low, high) in self.clocks.items()
        ]
        return notes

    def save(self, path: Path) -> None:
        """Write the result atomically."""
        with drafts.written(path, EnergyError):
            write_document(path, asdict(self), indent=2)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote; unknown keys are ignored."""
        with documents.reading(path, EnergyError, "not an energy file"):
            record = documents.from_json(documents.content(path))
            return TypeAdapter(cls).validate_python(record)


@dataclass(frozen=True)
class CountedBy:
    """Description of the counter, copied into the result."""

    counter: str
    device: str
    scope: str
    step_s: float


def summarise(
    windows: Sequence[Window],
    by: CountedBy,
    idle_w: float | None,
    *,
    states: Sequence[DeviceState] = (),
    power_j_per_frame: float | None = None,
) -> EnergyResult:
    """Return the energy result of one model.

    ``idle_w`` is None where the idle device was not measured; ``states`` are those
    before and after each window.
    """
    found = estimate(windows, by.step_s)
    frames = sum(each.frames for each in windows)
    frame_s = sum(each.taken_s for each in windows) / frames
    # Not every device reports temperatures or clocks.
    warmth = [e.temperature_c for e in states if e.temperature_c is not None]
    throttled = dict.fromkeys(reason for each in states for reason in each.throttled)
    return EnergyResult(
        joules=sum(each.joules for each in windows),
        frames=frames,
        j_per_frame=found.j_per_frame,
        net_j_per_frame=None
        if idle_w is None
        else found.j_per_frame - idle_w * frame_s,
        low=found.low,
        high=found.high,
        windows=len(windows),
        window_s=float(np.mean([each.taken_s for each in windows])),
        counter=by.counter,
        counter_step_s=by.step_s,
        idle_w=idle_w,
        temperature=(warmth[0], warmth[-1]) if warmth else None,
        clocks=_clocks(states),
        throttled=tuple(throttled),
        device=by.device,
        scope=by.scope,
        window_j_per_frame=tuple(each.joules / each.frames for each in windows),
        power_j_per_frame=power_j_per_frame,
    )


def _clocks(states: Sequence[DeviceState]) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest MHz of each clock."""
    seen: dict[str, list[float]] = {}
    for state in states:
        for name, mhz in state.clocks_mhz.items():
            seen.setdefault(name, []).append(mhz)
    return {name: (min(each), max(each)) for name, each in seen.items()}
