"""What runs in the process of its own: ``python worker.py GIVEN.onnx FOLDED.onnx``."""

import sys

import onnx
import onnxsim


def fold(given: str, folded: str) -> None:
    """Fold a file's constants with onnxsim; weights go to a data file beside it."""
    model, _ = onnxsim.simplify(given, perform_optimization=False)
    onnx.save(model, folded, save_as_external_data=True, location="folded.data")


if __name__ == "__main__":
    fold(*sys.argv[1:])
