"""Open and run a graph: ``opening_main.py MODEL INPUTS.npz STEPS KERNELS FUSION...``.

KERNELS are separated by commas; only for them does it import something of this package.
It prints each step before taking it, so that the last one is known if it dies.
"""

import sys

import numpy as np
import onnxruntime as ort

_NUMPY = {"float": "float32", "double": "float64"}


def main(model: str, inputs: str, steps: str, kernels: str, *disabled: str) -> None:
    """Open a file as a session does; run it once if the steps say so."""
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if kernels:
        from me2e_compress.operators.kernels import custom_ops

        custom_ops.register_named(options, kernels.split(","))
    # Announce each step, so that a crash can be located.
    sys.stdout.write("open\n")
    sys.stdout.flush()
    session = ort.InferenceSession(
        model,
        options,
        providers=["CPUExecutionProvider"],
        disabled_optimizers=list(disabled),
    )
    if steps != "run":
        return
    # Inputs that are not given are zeros.
    names, *arrays = np.load(inputs, allow_pickle=False).values()
    feeds = dict(zip(map(str, names), arrays, strict=True))
    for port in session.get_inputs():
        if port.name not in feeds:
            word = port.type.removeprefix("tensor(").removesuffix(")")
            feeds[port.name] = np.zeros(port.shape, _NUMPY.get(word, word))
    sys.stdout.write("run\n")
    sys.stdout.flush()
    session.run(None, {port.name: feeds[port.name] for port in session.get_inputs()})


if __name__ == "__main__":
    main(*sys.argv[1:])
