"""Budgets of a search, and the energy of a frame, measured or modelled."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

from me2e_compress.errors import EnergyError, RecipeError
from me2e_compress.runtime.energy.energy_counter import open_counter
from me2e_compress.runtime.energy.estimate import FEWEST_WINDOWS
from me2e_compress.runtime.energy.models import measure_energy
from me2e_compress.runtime.energy.reader import Reader
from me2e_compress.runtime.energy.schedule import EnergySchedule
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.workflows.checks import check_number
from me2e_compress.workflows.inspect import model_energy

Joules = Literal["J", "modelled J"]
"""The kind of energy figure; measured and modelled joules are never compared."""


def check_budgets(
    max_mb: float | None, max_ms: float | None, max_joules: float | None
) -> None:
    """Check that there is a budget, and that each is a finite number above 0."""
    check_number("--max-mb", max_mb)
    check_number("--max-ms", max_ms)
    check_number("--max-joules", max_joules)
    if (max_mb, max_ms, max_joules) == (None, None, None):
        raise RecipeError("give a budget: --max-mb, --max-ms or --max-joules, or more")


def joules_here() -> Joules:
    """Return which joules this machine can give: measured if a counter answers."""
    counter = open_counter()
    if not isinstance(counter, Reader):
        return "modelled J"
    counter.close()
    return "J"


def joules_of(
    kind: Joules,
    models: Mapping[str, Path],
    frames: Frames,
    *,
    module_map: str | Path | None = None,
    threads: int = 1,
    provider: Provider = CPU,
    on_window: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> dict[str, float]:
    """Return the joules per frame of each model, all measured or all modelled.

    `models` maps names to ONNX files; `threads` is onnxruntime's, and 0 takes all.
    Models are measured in turn, over the fewest windows that still give an interval;
    `on_window` gets the windows done, their total and a name.
    """
    # the models take turns, so that a drift of the machine meets all of them
    if kind == "J":
        schedule = EnergySchedule(windows=FEWEST_WINDOWS)
        measured = measure_energy(
            models,
            frames,
            schedule=schedule,
            threads=threads,
            provider=provider,
            on_window=on_window,
        )
        found = {name: each.j_per_frame for name, each in measured.items()}
    else:
        modelled = {
            name: model_energy(path, module_map=module_map)
            for name, path in models.items()
        }
        found = {name: each.modelled_j_per_frame for name, each in modelled.items()}
    # a budget needs a number for every model
    for name, joules in found.items():
        if joules is None:
            raise EnergyError(f"{models[name]}: its joules are not known")
    return {name: joules for name, joules in found.items() if joules is not None}
