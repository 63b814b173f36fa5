"""Run another calibration or quantization tool, in an interpreter of its own.

    python benchmarks/tools/peer.py TOOL MODEL.onnx FRAMES/ OUT --frames 8 --threads 2

It needs none of this package, so that a tool may live in an environment of its own.
Prints one line of JSON: seconds of CPU and of the clock, largest resident set in MB.

Tools: ``onnxruntime-minmax`` (calibration alone; OUT is a JSON of ranges),
``onnxruntime-entropy`` (the same), ``onnxruntime`` (quantize_static, symmetric, one
scale a channel), ``onnxruntime-uint8`` (the same, activations asymmetric uint8: its
fastest), ``onnxruntime-uint8-tensor`` (the same, one scale a weight: what it can run
where a MatMul is of rank 3) and ``modelopt`` (quantize, max, high precision float32).
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.calibrate import create_calibrator

LAYERS = ["Conv", "ConvTranspose", "Gemm", "MatMul"]
STATIC = ("onnxruntime", "onnxruntime-uint8", "onnxruntime-uint8-tensor")
METHODS = {
    "onnxruntime-minmax": CalibrationMethod.MinMax,
    "onnxruntime-entropy": CalibrationMethod.Entropy,
}


class Reader(CalibrationDataReader):  # type: ignore[misc]
    """Feeds recorded frames; what they lack, a recurrent state, is zero."""

    def __init__(self, model: Path, folder: Path, count: int) -> None:
        graph = onnx.load(model, load_external_data=False).graph
        weights = {each.name for each in graph.initializer}
        self.shapes = {
            port.name: [size.dim_value for size in port.type.tensor_type.shape.dim]
            for port in graph.input
            if port.name not in weights
        }
        self.files = sorted(folder.glob("*.npz"))[:count]
        self._left = iter(self.files)

    def get_next(self) -> Any:
        """Give the next frame, or None: what the tools expect, against their types."""
        return next(self._frames(), None)

    def rewind(self) -> None:
        self._left = iter(self.files)

    def get_first(self) -> Any:
        self.rewind()
        first = self.get_next()
        self.rewind()
        return first

    def _frames(self) -> Iterator[dict[str, np.ndarray[Any, Any]]]:
        for path in self._left:
            with np.load(path) as held:
                yield {
                    name: held[name] if name in held else np.zeros(shape, np.float32)
                    for name, shape in self.shapes.items()
                }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tool", choices=[*METHODS, *STATIC, "modelopt"])
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--threads", type=int, default=2)
    chosen = parser.parse_args()
    limit_threads(chosen.threads)
    cpu, wall = time.process_time(), time.perf_counter()
    run(chosen)
    print(
        json.dumps(
            {
                "cpu_s": time.process_time() - cpu,
                "wall_s": time.perf_counter() - wall,
                "peak_mb": peak_mb(),
            }
        )
    )


def run(chosen: argparse.Namespace) -> None:
    reader = Reader(chosen.model, chosen.folder, chosen.frames)
    if chosen.tool == "modelopt":
        quantize_with_modelopt(chosen.model, reader, chosen.output)
    elif chosen.tool in STATIC:
        symmetric = chosen.tool == "onnxruntime"
        quantize_static(
            chosen.model,
            chosen.output,
            reader,
            quant_format=QuantFormat.QDQ,
            per_channel=not chosen.tool.endswith("-tensor"),
            activation_type=QuantType.QInt8 if symmetric else QuantType.QUInt8,
            extra_options={"ActivationSymmetric": symmetric, "WeightSymmetric": True},
        )
    else:
        calibrate(chosen.model, reader, METHODS[chosen.tool], chosen.output)


def calibrate(model: Path, reader: Reader, method: Any, output: Path) -> None:
    """Measure what the layers read and write, as the tool does on its own."""
    augmented = output.with_suffix(".onnx")
    tool = create_calibrator(
        model, LAYERS, augmented_model_path=str(augmented), calibrate_method=method
    )
    tool.collect_data(reader)
    data = tool.compute_data().data
    ranges = {
        name: [float(end.item()) for end in entry.range_value]
        for name, entry in data.items()
    }
    output.write_text(json.dumps(ranges))


def quantize_with_modelopt(model: Path, reader: Reader, output: Path) -> None:
    from modelopt.onnx import quantization  # pyright: ignore[reportMissingImports]

    quantization.quantize(
        str(model),
        calibration_method="max",
        calibration_data_reader=reader,
        calibration_eps=["cpu"],
        high_precision_dtype="fp32",
        output_path=str(output),
        log_level="ERROR",
    )


def peak_mb() -> float:
    """Largest resident set of this process, MB; Linux.

    Not getrusage: there a process inherits the peak of the one that started it.
    """
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    (line,) = (each for each in status.splitlines() if each.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def limit_threads(count: int) -> None:
    """Let every session that the tool opens use as many threads as ours."""
    original = onnxruntime.SessionOptions

    def limited() -> Any:
        options = original()
        options.intra_op_num_threads = count
        options.log_severity_level = 4
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        return options

    onnxruntime.SessionOptions = limited


if __name__ == "__main__":
    main()
