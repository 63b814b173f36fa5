"""Run TensorRT-RTX in a separate process, because its parser may abort.

python rtx_main.py MODEL.onnx ANSWER.json SM build|parse
"""

import json
import sys
from pathlib import Path

import tensorrt_rtx as trt


class _Log(trt.ILogger):  # type: ignore[misc]
    """Keeps the messages of warning level and above."""

    def __init__(self) -> None:
        trt.ILogger.__init__(self)
        self.lines: list[str] = []

    def log(self, severity: trt.ILogger.Severity, message: str) -> None:
        """Keep one line."""
        if severity <= trt.ILogger.Severity.WARNING:
            self.lines.append(f"{severity.name.lower()}: {message}")


def work(model: Path, sm: int, *, build: bool) -> dict[str, object]:
    """Parse a file, and build it for a GPU generation if asked to."""
    log = _Log()
    builder = trt.Builder(log)
    network = builder.create_network(0)
    parser = trt.OnnxParser(network, log)
    # Parse, and collect what the parser reports.
    parsed = parser.parse_from_file(str(model))
    errors = [parser.get_error(index) for index in range(parser.num_errors)]
    answer: dict[str, object] = {
        "version": trt.__version__,
        "parsed": parsed,
        "errors": [
            f"{each.node_operator()} {each.node_name()!r}: {each.desc()}"
            for each in errors
        ],
        "layers": network.num_layers,
        "built": None,
    }
    # Build for the generation without a GPU.
    if parsed and build:
        config = builder.create_builder_config()
        config.num_compute_capabilities = 1
        config.set_compute_capability(getattr(trt.ComputeCapability, f"SM{sm}"), 0)
        built = builder.build_serialized_network(network, config)
        answer["built"] = built is not None
    answer["log"] = log.lines
    return answer


def main() -> None:
    """Read the arguments, write the answer."""
    model, answer, sm, until = sys.argv[1:]
    result = work(Path(model), int(sm), build=until == "build")
    Path(answer).write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    main()
