"""Compile a graph in OpenVINO: ``openvino_opening_main.py MODEL CONFIG``.

CONFIG is JSON. Whether this process dies is the answer; a graph that is refused is not
one that it dies of.
"""

import json
import sys

import openvino as ov

from me2e_compress.operators.kernels.openvino_ops import extensions

if __name__ == "__main__":
    core = ov.Core()
    for extension in extensions(1):
        core.add_extension(extension)
    core.compile_model(core.read_model(sys.argv[1]), "CPU", json.loads(sys.argv[2]))
