"""Open and run a graph: ``opening_main.py MODEL FOLDER KERNELS FUSION...``.

KERNELS are separated by commas; only for them does it import something of this package.
FOLDER holds ``steps.json`` and the inputs of each frame, ``0.npz`` and so on; what the
graph answers is written there, ``0.answer.npz`` and so on. It prints each step before
taking it, so that the last one is known if it dies.
"""

import ctypes
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

_NUMPY = {"float": "float32", "double": "float64"}


def main(model: str, folder: str, kernels: str, *disabled: str) -> None:
    """Open a file as a session does; run it on the frames that the folder holds."""
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.enable_mem_pattern = False
    options.enable_mem_reuse = False  # it keeps buffers for a later layer: a fifth more
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if kernels:
        from me2e_compress.operators.kernels import custom_ops

        custom_ops.register_named(options, kernels.split(","))
    # Announce each step, so that a crash can be located.
    _say("open")
    session = ort.InferenceSession(
        model,
        options,
        providers=["CPUExecutionProvider"],
        disabled_optimizers=list(disabled),
    )
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # glibc's
        trim(0)  # what opening left behind is a tenth of the memory of a run
    steps = json.loads(Path(folder, "steps.json").read_bytes())
    for index, answer in enumerate(_replay(session, Path(folder), steps)):
        write(Path(folder, f"{index}.answer.npz"), answer)


def _replay(
    session: ort.InferenceSession, folder: Path, steps: Mapping[str, Any]
) -> Iterator[Mapping[str, Any]]:
    """Run the frames in order, state fed forward; inputs that are missing are zeros."""
    ports = {each.name: each for each in session.get_inputs()}
    names = [each.name for each in session.get_outputs()]
    state: dict[str, Any] = {}
    for index, starts in enumerate(steps["starts"]):
        frame = read(folder / f"{index}.npz")
        if starts:
            state = {}
        feeds = {**frame, **state}
        for name, port in ports.items():
            if name not in feeds:
                word = port.type.removeprefix("tensor(").removesuffix(")")
                feeds[name] = np.zeros(port.shape, _NUMPY.get(word, word))
        _say("run")
        values = session.run(names, {name: feeds[name] for name in ports})
        answer = dict(zip(names, values, strict=True))
        state = {name: answer[to] for name, to in steps["recurrent"].items()}
        yield answer


def write(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by number, and their names first, so that any name is allowed."""
    np.savez(
        path, np.array(list(arrays), np.str_), *arrays.values(), allow_pickle=False
    )


def read(path: Path) -> dict[str, Any]:
    """Read what :func:`write` wrote."""
    with np.load(path, allow_pickle=False) as file:
        names, *arrays = file.values()
    return dict(zip(map(str, names), arrays, strict=True))


def _say(step: str) -> None:
    sys.stdout.write(f"{step}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
