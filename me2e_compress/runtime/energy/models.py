"""Measure the energy of ONNX files on this machine, in turn."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from itertools import chain, repeat
from pathlib import Path

from me2e_compress.errors import EnergyError
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.energy.energy_counter import (
    EnergyRecording,
    EnergySchedule,
    open_counter,
)
from me2e_compress.runtime.energy.energy_result import Absent, EnergyResult, Reader
from me2e_compress.runtime.energy.meter import EnergyMeter
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay

MOST_BYTES = 500_000_000
"""Bytes of frames held in memory: reading from disk takes energy too."""


def measure_energy(
    models: Mapping[str, Path],
    frames: Frames,
    counter: str = "auto",
    schedule: EnergySchedule | None = None,
    *,
    threads: int = 1,
    provider: Provider = CPU,
    said: Mapping[str, str] | None = None,
    on_window: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> dict[str, EnergyResult]:
    """Measure the energy of models, one frame at a time, in alternating windows.

    Recurrent state is fed forward and reset where scenes begin. The first frames, as
    many as fit into 500 MB, are repeated as often as needed. Nothing else may run on
    the device. ``models`` has ONNX files by name; ``counter``
    is described at ``open_counter``; ``said`` is metadata that overrides the models'
    own; ``on_window`` is called with windows done, windows in all, and the model's
    name.

    Returns joules per frame by model; without a counter, the reason why not, at once. A
    counter that fails, or a recording given for several models, is an EnergyError.
    """
    digests = {name: sha256_of(path) for name, path in models.items()}
    # Measure, take the recording, or say why there is no counter.
    opened = open_counter(counter)
    if isinstance(opened, Absent):
        found = dict.fromkeys(models, EnergyResult(reason=opened.reason))
    elif isinstance(opened, EnergyRecording):
        if len(models) != 1:
            raise EnergyError(
                f"energy {counter}: a recording is of one model, and there are"
                f" {len(models)}: {', '.join(models)}"
            )
        found = dict.fromkeys(models, opened.measured(schedule or EnergySchedule()))
    else:
        found = _metered(
            *(models, frames, opened, schedule, threads, provider, on_window, said)
        )
    # Each result carries the digest of its model's files.
    return {
        name: dataclasses.replace(result, model_sha256=digests[name])
        for name, result in found.items()
    }


def _metered(
    models: Mapping[str, Path],
    frames: Frames,
    reader: Reader,
    schedule: EnergySchedule | None,
    threads: int,
    provider: Provider,
    on_window: Callable[[int, int, str], None],
    said: Mapping[str, str] | None,
) -> dict[str, EnergyResult]:
    try:
        held = _held(frames)
        sessions = {
            name: Session(
                path, threads=threads, int8_kernels=True, provider=provider, said=said
            )
            for name, path in models.items()
        }
        # Each model replays the frames held in memory endlessly.
        work = {
            name: replay(session, chain.from_iterable(repeat(held))).__next__
            for name, session in sessions.items()
        }
        return EnergyMeter(reader, schedule, on_window=on_window).measure(work)
    finally:
        reader.close()


def _held(frames: Frames) -> list[Frame]:
    """Keep the first frames that fit into memory, at least one."""

    def fitting() -> Iterator[Frame]:
        taken = 0
        for frame in frames:
            taken += sum(each.nbytes for each in frame.arrays.values())
            if frame.index and taken > MOST_BYTES:
                return
            yield frame

    held = list(fitting())
    if not held:
        raise EnergyError("energy: there is no frame to run")
    return held
