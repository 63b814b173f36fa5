"""Open a graph, and run it once: ``opening_main.py MODEL INPUTS KERNELS FUSION...``.

INPUTS is an ``.npz``; where there is no such file, the graph is only opened. KERNELS
are separated by commas; only for them does it import something of this package. It
prints each step before taking it, so that the last one is known if it dies. A graph
that only onnxruntime's optimizer refuses is opened unoptimized, after the reason.
"""

import ctypes
import functools
import sys
from pathlib import Path

import numpy as np
import onnxruntime as ort

_NUMPY = {"float": "float32", "double": "float64"}


def main(model: str, inputs: str, kernels: str, *disabled: str) -> None:
    """Open a file as a session does; run it on the inputs, and zeros for the others."""
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
    if not Path(inputs).exists():
        return
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # glibc's
        trim(0)  # what opening has freed is a tenth of the memory of a run
    with np.load(inputs, allow_pickle=False) as file:
        feeds = dict(file)
    for port in session.get_inputs():
        if port.name not in feeds:
            word = port.type.removeprefix("tensor(").removesuffix(")")
            feeds[port.name] = np.zeros(port.shape, _NUMPY.get(word, word))
    _print("run")
    session.run(None, {port.name: feeds[port.name] for port in session.get_inputs()})


def _print(step: str) -> None:
    sys.stdout.write(f"{step}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
