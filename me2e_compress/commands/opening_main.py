"""Open a graph, and run frames: ``opening_main.py MODEL FOLDER STATE KERNELS ...``.

FOLDER has frames of one scene, ``0.npz``, ``1.npz``, ...; without any the graph is only
opened. Outputs of frame N that are numbers become ``N.out.npz``, in order. STATE is
JSON that pairs recurrent inputs with outputs. KERNELS are separated by commas; only for
them does it import something of this package. Fusions to leave out follow. It prints
each step before taking it, so that the last one is known if it dies. A graph that only
onnxruntime's optimizer refuses is opened unoptimized, after the reason.
"""

import ctypes
import functools
import json
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

_NUMPY = {"float": "float32", "double": "float64"}


def main(model: str, folder: str, pairs: str, kernels: str, *disabled: str) -> None:
    """Open a file as a session does; run it on frames, and zeros for other inputs."""
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.enable_mem_pattern = False
    options.enable_mem_reuse = False  # it keeps buffers for a later layer: a fifth more
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if kernels:
        from me2e_compress.operators.kernels import custom_ops

        custom_ops.register_named(options, kernels.split(","))
    _print("open")
    open_it = functools.partial(
        ort.InferenceSession,
        model,
        options,
        providers=["CPUExecutionProvider"],
        disabled_optimizers=list(disabled),
    )
    try:
        session = open_it()
    except Exception as refusal:  # whatever it raises: it is tried once more
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        _print(" ".join(str(refusal).split()))
        _print("plain")
        session = open_it()
    frames = sorted(Path(folder).glob("*.npz"), key=lambda path: int(path.stem))
    if not frames:
        return
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # glibc's
        trim(0)  # what opening has freed is a tenth of the memory of a run
    names = [port.name for port in session.get_outputs()]
    state: dict[str, npt.NDArray[np.generic]] = {}
    _print("run")
    for path in frames:
        with np.load(path, allow_pickle=False) as file:
            feeds = {**file, **state}
        for port in session.get_inputs():
            if port.name not in feeds:
                word = port.type.removeprefix("tensor(").removesuffix(")")
                feeds[port.name] = np.zeros(port.shape, _NUMPY.get(word, word))
        inputs = {port.name: feeds[port.name] for port in session.get_inputs()}
        # An output keeps the memory of its run alive, but for copies
        made = dict(zip(names, map(np.array, session.run(None, inputs)), strict=True))
        if not all(array.dtype.kind in "fiub" for array in made.values()):
            return
        np.savez(path.with_suffix(".out.npz"), *made.values())
        state = {name: made[answer] for name, answer in json.loads(pairs).items()}


def _print(step: str) -> None:
    sys.stdout.write(f"{step}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
