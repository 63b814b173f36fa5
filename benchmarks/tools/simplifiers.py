"""Tools that simplify a graph, each in a started process of its own, file to file.

    python -m benchmarks.tools.simplifiers MODEL.onnx TARGET.onnx --tool onnxsim

What a run took is the last line, in JSON: start-up (the CPU time until the imports are
done), the work, and the largest resident set.
"""

import argparse
import contextlib
import dataclasses
import io
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.tools.processes import answer
from benchmarks.tools.run_one import peak_mb

SYNTHETIC_MAP = """
[modules.stack]
role = "feature"
optional = ["stage.*"]
"""
TOOLS = ("ours", "ours, verified", "onnxsim", "onnxslim", "onnxruntime basic")
Work = Callable[[], None]


@dataclasses.dataclass(frozen=True)
class Job:
    """What a tool is to do.

    Attributes:
        source: the model.
        target: where the smaller one goes.
        preset: a module map; empty for the synthetic graph's own.
        frames: folder of recorded frames; None without.
    """

    source: Path
    target: Path
    preset: str
    frames: Path | None


@dataclasses.dataclass(frozen=True)
class Taken:
    """What one run of a tool took.

    Attributes:
        startup_s: CPU time until its imports were done, seconds.
        cpu_s: CPU time of the work, seconds.
        wall_s: wall time of the work, seconds.
        peak_mb: largest resident memory, imports included.
    """

    startup_s: float
    cpu_s: float
    wall_s: float
    peak_mb: float


def ours(job: Job, verify_frames: int = 0) -> Work:
    from me2e_compress.commands.compress import compress
    from me2e_compress.commands.options import CompressOptions

    module_map: str | Path = job.preset
    if not job.preset:
        module_map = job.target.with_name("synthetic.toml")
        module_map.write_text(SYNTHETIC_MAP)
    options = CompressOptions(module_map=module_map, verify_frames=verify_frames)
    frames = job.frames if verify_frames else None

    def work() -> None:
        compress(job.source, job.target, "exact", frames, options)

    return work


def verified(job: Job) -> Work:
    return ours(job, verify_frames=2)


def onnxsim(job: Job) -> Work:
    import onnx
    import onnxsim

    def work() -> None:
        simplified, _ = onnxsim.simplify(onnx.load(job.source))
        onnx.save(simplified, job.target)

    return work


def onnxslim(job: Job) -> Work:
    import onnx
    import onnxslim

    def work() -> None:
        slimmed = onnxslim.slim(onnx.load(job.source))
        if not isinstance(slimmed, onnx.ModelProto):
            raise SystemExit(f"onnxslim gave {type(slimmed).__name__}, not a model")
        onnx.save(slimmed, job.target)

    return work


def onnxruntime_basic(job: Job) -> Work:
    import onnxruntime

    def work() -> None:
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = (
            onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        )
        options.optimized_model_filepath = str(job.target)
        options.intra_op_num_threads = 1
        options.log_severity_level = 4
        onnxruntime.InferenceSession(job.source, options)

    return work


def work_alone(tool: str, job: Job) -> None:
    """Run one tool here and print what it took as the last line, in JSON."""
    tools = (ours, verified, onnxsim, onnxslim, onnxruntime_basic)
    prepare = tools[TOOLS.index(tool)]
    work = prepare(job)
    startup, wall = time.process_time(), time.perf_counter()
    with contextlib.redirect_stderr(io.StringIO()):
        work()
    cpu, wall = time.process_time() - startup, time.perf_counter() - wall
    taken = Taken(startup, cpu, wall, peak_mb())
    print(json.dumps(dataclasses.asdict(taken)))


def measure(tool: str, job: Job) -> Taken:
    """Run one tool in its own process."""
    command = [sys.executable, "-m", "benchmarks.tools.simplifiers", str(job.source)]
    command += [str(job.target), "--tool", tool, "--map", job.preset]
    command += [] if job.frames is None else ["--verify", str(job.frames)]
    found = answer(command)
    if isinstance(found, str):
        raise SystemExit(f"{tool}: {found}")
    return Taken(**found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--tool", choices=TOOLS, required=True)
    parser.add_argument("--map", default="")
    parser.add_argument("--verify", type=Path)
    given = parser.parse_args()
    work_alone(given.tool, Job(given.model, given.target, given.map, given.verify))


if __name__ == "__main__":
    main()
