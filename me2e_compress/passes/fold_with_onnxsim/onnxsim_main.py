"""The script of the separate process: ``python worker.py GIVEN.onnx FOLDED.onnx``."""

import sys

import onnx
import onnxsim


def fold(source: str, folded: str) -> None:
    """Fold a file's constants with onnxsim; weights go to a data file next to it."""
    model, _ = onnxsim.simplify(source, perform_optimization=False)
    onnx.save(model, folded, save_as_external_data=True, location="folded.data")


if __name__ == "__main__":
    fold(*sys.argv[1:])
