"""Run TensorRT-RTX in a separate process, because its parser may abort.

python rtx_main.py MODEL.onnx ANSWER.json SM [PLAN]
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


def work(model: Path, sm: int, plan: Path | None) -> dict[str, object]:
    """Parse a file, and build it for a GPU generation if a plan is wanted."""
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
    if parsed and plan is not None:
        config = builder.create_builder_config()
        config.num_compute_capabilities = 1
        config.set_compute_capability(getattr(trt.ComputeCapability, f"SM{sm}"), 0)
        config.profiling_verbosity = trt.ProfilingVerbosity.DETAILED
        built = builder.build_serialized_network(network, config)
        answer["built"] = built is not None
        if built is not None:
            plan.write_bytes(bytes(built))
    answer["log"] = log.lines
    return answer


def main() -> None:
    """Read the arguments, write the answer."""
    model, answer, sm = sys.argv[1:4]
    plan = Path(sys.argv[4]) if len(sys.argv) > 4 else None
    found = work(Path(model), int(sm), plan)
    Path(answer).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
