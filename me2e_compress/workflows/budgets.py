"""Budgets of a search, and the measured energy of a frame."""

from pathlib import Path

from me2e_compress.errors import EnergyError, RecipeError
from me2e_compress.runtime.energy.energy_counter import EnergySchedule, open_counter
from me2e_compress.runtime.energy.energy_result import FEWEST_WINDOWS, Absent, Reader
from me2e_compress.runtime.energy.meter import measure_energy
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import Provider
from me2e_compress.workflows.checks import check_number


def check_budgets(
    max_mb: float | None, max_ms: float | None, max_joules: float | None
) -> None:
    """Check that there is a budget, and that each is a finite number above 0."""
    check_number("--max-mb", max_mb)
    check_number("--max-ms", max_ms)
    check_number("--max-joules", max_joules)
    if (max_mb, max_ms, max_joules) == (None, None, None):
        raise RecipeError("give a budget: --max-mb, --max-ms or --max-joules, or more")


def need_counter() -> None:
    """Raise EnergyError if no counter answers on this machine."""
    counter = open_counter()
    if isinstance(counter, Absent):
        raise EnergyError(f"--max-joules: {counter.reason}")
    if isinstance(counter, Reader):
        counter.close()


def joules_of(model: Path, frames: Frames, provider: Provider) -> float:
    """Measure joules per frame over the fewest windows that give an interval."""
    schedule = EnergySchedule(windows=FEWEST_WINDOWS)
    found = measure_energy(
        {"model": model},
        frames,
        schedule=schedule,
        threads=0,
        provider=provider,
    )["model"]
    if found.j_per_frame is None:
        raise EnergyError(f"{model}: its joules are not known: {found.reason}")
    return found.j_per_frame
