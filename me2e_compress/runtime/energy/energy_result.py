"""The measured energy of a model on one machine, or the reason why there is none."""

import abc
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Self, TypeAlias

import numpy as np
from pydantic import Field, TypeAdapter

from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import write_document
from me2e_compress.base.display import Table, table
from me2e_compress.base.errors import EnergyError


class Reader(abc.ABC):
    """An open counter that counts energy, or else reads power.

    Attributes:
        counter: name of the counter, for the result.
        device: name of the device.
        scope: what is counted: a board, packages, rails.
        step_s: seconds between updates; 0.1, as GPUs have it, where nothing says so.
        counts: whether it counts energy; otherwise its power is integrated.
    """

    counter: str
    device: str
    scope: str
    step_s: float = 0.1
    counts: bool = True

    def joules(self) -> float:
        """Return the joules since an arbitrary start; EnergyError if it went back."""
        raise NotImplementedError

    def watts(self) -> float:
        """Return the present power; an EnergyError if it cannot be read any more."""
        raise NotImplementedError

    def throttled(self) -> tuple[str, ...]:
        """Return why the device slows itself down, as far as it is known."""
        return ()

    def close(self) -> None:
        """Release what was opened; the default does nothing."""
        return


@dataclass(frozen=True)
class Absent:
    """A counter that is missing or may not be read, with the reason."""

    reason: str


FEWEST_WINDOWS = 5
# Fewest windows to fit the drift by a parabola: warming up slows down.
PARABOLA_WINDOWS = 8
# Relative error that the time between two updates of a counter may have
STEP_TOLERANCE = 2e-4


@dataclass(frozen=True)
class Window:
    """A run of back-to-back frames between two readings of a counter.

    ``joules`` is the counter's increase.
    """

    begin_s: float
    end_s: float
    frames: int
    joules: float

    @property
    def taken_s(self) -> float:
        """The length of the window in seconds."""
        return self.end_s - self.begin_s

    @property
    def watts(self) -> float:
        """The mean power."""
        return self.joules / self.taken_s


def estimate(windows: Sequence[Window], step_s: float) -> tuple[float, float, float]:
    """Return joules per frame over windows of one model, and the 95 % interval.

    ``step_s`` are the seconds between two updates of the counter. At least
    :data:`FEWEST_WINDOWS` are needed.
    """
    from scipy.special import stdtrit  # takes a moment to import

    frames = np.array([window.frames for window in windows], float)
    lengths_s = np.array([window.taken_s for window in windows])
    watts = np.array([window.watts for window in windows])
    per_frame = watts * lengths_s / frames
    # Warm-up and drift are no noise: a straight line over time, or a parabola, is
    # fitted, and Student's t applies to the residuals
    middle = np.array([(window.begin_s + window.end_s) / 2 for window in windows])
    degree = 2 if len(windows) >= PARABOLA_WINDOWS else 1
    freedom = len(windows) - 1 - degree
    drift = np.polynomial.Polynomial.fit(middle, per_frame, degree)
    residuals = per_frame - drift(middle)
    # Windows begin at a random phase of the counter, so that its step, its part-time
    # sensing and its noise show in their spread. If they lie closer together than the
    # step alone allows, its error replaces the spread: a window of whole steps and r
    # more seconds holds one step more or less by chance, a standard deviation of
    # power x sqrt(r (step - r)), for the worst r that the step leaves open
    from_whole = np.abs(lengths_s - step_s * np.round(lengths_s / step_s))
    past_step = np.minimum(from_whole + STEP_TOLERANCE * lengths_s, step_s / 2)
    ends = watts / frames * np.sqrt(past_step * (step_s - past_step))
    variance = max(float(residuals @ residuals) / freedom, float(np.mean(ends**2)))
    quantile = float(stdtrit(freedom, 0.975))  # both sides 95 %
    half = quantile * math.sqrt(variance / len(windows))
    mean = float(per_frame.mean())
    return mean, max(0.0, mean - half), mean + half


Finite: TypeAlias = Annotated[float, Field(allow_inf_nan=False)]
NotNegative: TypeAlias = Annotated[float, Field(allow_inf_nan=False, ge=0)]
Positive: TypeAlias = Annotated[float, Field(allow_inf_nan=False, gt=0)]


@dataclass(frozen=True, repr=False)
class EnergyResult:
    """Energy per frame over windows of a counter; None means not measured.

    Frames run one at a time, back to back, as in MLPerf's SingleStream.

    Attributes:
        joules: of all windows; idle power included.
        frames: inferences in all windows.
        j_per_frame: idle power included; gross.
        net_j_per_frame: without idle power; noise may make it negative.
        low: 95 % interval of ``j_per_frame``. It covers repetition on this device and
            counter, not the error of the counter itself.
        high: likewise.
        windows: number of windows.
        window_s: mean seconds of a window.
        counter: ``nvml-total`` or another.
        counter_step_s: seconds between its updates.
        idle_w: watts of the idle device; mean of before and after, the model loaded.
        throttled: why the device slowed itself down in a window.
        device: name of the device.
        scope: what the counter covers: a board, packages, rails.
        reason: why nothing was measured; empty if it was.
        model_sha256: digest of the model that ran; None if unknown.
        window_j_per_frame: joules per frame of each window.
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
    throttled: tuple[str, ...] = ()
    device: str = ""
    scope: str = ""
    reason: str = ""
    model_sha256: str | None = None
    window_j_per_frame: tuple[Finite, ...] = ()

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

    def alerts(self) -> tuple[str, ...]:
        """Return reasons to doubt the figure."""
        if not self.throttled:
            return ()
        slowed = ", ".join(self.throttled)
        return (f"energy: the device slowed itself down: {slowed}",)

    def tables(self) -> tuple[Table, ...]:
        """Return the table of figures; empty if nothing was measured."""
        if self.j_per_frame is None:
            return ()
        rows = [
            ("gross", f"{self.j_per_frame:.4g}", f"{self.low:.4g}", f"{self.high:.4g}")
        ]
        if self.net_j_per_frame is not None:
            rows.append(("net of idle", f"{self.net_j_per_frame:.4g}", "", ""))
        # Below the figures: how they were measured.
        long = f" of {self.window_s:.1f} s" if self.window_s else ""
        notes = [f"{self.frames} frames in {self.windows} windows{long}"]
        if self.idle_w is not None:
            notes.append(f"idle {self.idle_w:.4g} W")
        columns = ("energy", "J/frame", "low 95 %", "high 95 %")
        title = f"{self.counter} of {self.device} ({self.scope})"
        return (table(title, columns, rows, "\n".join(notes)),)

    def save(self, path: Path) -> None:
        """Write the result atomically; an EnergyError if it cannot be written."""
        with atomic.writing_errors(path, EnergyError):
            write_document(path, asdict(self), indent=2)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote, without unknown keys; else an EnergyError."""
        with documents.reading(path, EnergyError, "not an energy file"):
            record = documents.from_json(documents.read_bytes(path))
            return TypeAdapter(cls).validate_python(record)


def summarise(
    windows: Sequence[Window],
    by: tuple[str, str, str, float],
    idle_w: float | None,
    throttled: Sequence[str] = (),
) -> EnergyResult:
    """Return the energy result of one model.

    ``by`` is the counter, the device, its scope, and the seconds between two updates;
    ``idle_w`` is None where the idle device was not measured; ``throttled`` is why the
    device slowed itself down around any window.
    """
    counter, device, scope, step_s = by
    j_per_frame, low, high = estimate(windows, step_s)
    # Idle power is taken off for the mean time of a frame
    frames = sum(window.frames for window in windows)
    frame_s = sum(window.taken_s for window in windows) / frames
    return EnergyResult(
        joules=sum(window.joules for window in windows),
        frames=frames,
        j_per_frame=j_per_frame,
        net_j_per_frame=None if idle_w is None else j_per_frame - idle_w * frame_s,
        low=low,
        high=high,
        windows=len(windows),
        window_s=float(np.mean([window.taken_s for window in windows])),
        counter=counter,
        counter_step_s=step_s,
        idle_w=idle_w,
        throttled=tuple(dict.fromkeys(throttled)),
        device=device,
        scope=scope,
        window_j_per_frame=tuple(window.joules / window.frames for window in windows),
    )
