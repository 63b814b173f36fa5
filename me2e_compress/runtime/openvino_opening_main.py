"""Compile a graph in OpenVINO: ``openvino_opening_main.py MODEL CONFIG``.

CONFIG is JSON. Whether this process dies is the answer; a graph that is refused is not
one that it dies of.
"""

import json
import sys

from me2e_compress.operators.kernels import why_not
from me2e_compress.runtime.openvino import new_core

if __name__ == "__main__":
    core = new_core(1 if why_not() is None else None)
    core.compile_model(core.read_model(sys.argv[1]), "CPU", json.loads(sys.argv[2]))
