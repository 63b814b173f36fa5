"""Measure the energy of ONNX files on this machine, in turn."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from itertools import chain, repeat
from pathlib import Path

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import open_counter
from me2e_compress.runtime.energy.energy_recording import EnergyRecording
from me2e_compress.runtime.energy.energy_result import EnergyResult
from me2e_compress.runtime.energy.meter import EnergyMeter
from me2e_compress.runtime.energy.reader import Absent, Reader
from me2e_compress.runtime.energy.schedule import EnergySchedule
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import replay
from me2e_compress.runtime.stack.split_stack import digest_of_files
from me2e_compress.runtime.stack.stack_session import open_session

MOST_BYTES = 500_000_000
"""Frames are held in memory up to here: reading them from disk takes energy too."""


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
    """Measure the energy of models, one frame at a time, window by window in turn.

    Recurrent state is fed forward and reset where scenes begin; the first frames, as
    many as fit into 500 MB, are repeated as often as it takes. Nothing else may run on
    the device.

    Args:
        models: ONNX files, or TOMLs of stacks, by name.
        frames: What they see.
        counter: ``auto``, or a name and options; see ``open_counter``.
        schedule: How long, and how often; None takes the defaults.
        threads: Of onnxruntime.
        provider: What runs them.
        said: What is known of them beside their own metadata.
        on_window: Called with windows done, windows in all, and the model's name.

    Returns:
        By model: joules a frame; or, without a counter, why not, at once.

    Raises:
        EnergyError: The counter goes back, stands still or cannot be read; or a
            recording is asked to tell of several models.
        GraphError: A model cannot be run.
        FramesError: A frame does not fit, or there is none.
    """
    digests = {name: digest_of_files(path) for name, path in models.items()}
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
            name: open_session(path, threads=threads, provider=provider, said=said)
            for name, path in models.items()
        }
        work = {
            name: replay(session, chain.from_iterable(repeat(held))).__next__
            for name, session in sessions.items()
        }
        return EnergyMeter(reader, schedule, on_window=on_window).measure(work)
    finally:
        reader.close()


def _held(frames: Frames) -> list[Frame]:
    """Keep the first frames, as many as memory is meant for, at least one."""

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
