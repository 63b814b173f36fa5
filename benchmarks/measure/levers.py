"""What each setting of onnxruntime is worth on one graph, against our sessions.

    python -m benchmarks.measure.levers MODEL FRAMES [--rounds 3] [--threads 2]
        [--only "prepacking off;IO binding"]

One frame, the first of FRAMES, recurrent state at zeros. A session as ours and one with
a single setting changed run in turn, in one process, so that whatever else runs on the
machine falls on both; a warm-up each, then so many rounds. CPU seconds are those of all
threads; the ratio is that of the least of either. Below 1, the setting would be faster.
The last column is the same of opening the file, the least of two. MODEL holds operators
that onnxruntime brings itself.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnxruntime as ort

from benchmarks.tools.processes import in_turn
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.profile import processor
from me2e_compress.runtime.providers import CPU, SLOW_FUSIONS
from me2e_compress.runtime.session import DTYPES, REFUSALS, Session

Feeds = Mapping[str, Array]
Run = Callable[[], object]
Change = Callable[[ort.SessionOptions], None]
LEVELS = ort.GraphOptimizationLevel


@dataclasses.dataclass(frozen=True)
class Cost:
    """Least CPU seconds of a session.

    Attributes:
        run: of a frame.
        opening: of opening the file.
    """

    run: float
    opening: float


@dataclasses.dataclass(frozen=True)
class Lever:
    """One setting that differs from our sessions.

    Attributes:
        change: of the options of the session.
        left_out: optimizations left out besides ours.
        made: those of ours that are made.
        bound: inputs and outputs are bound to memory once.
        stored: the optimized graph is opened in onnxruntime's own format.
    """

    change: Change = lambda options: None
    left_out: tuple[str, ...] = ()
    made: tuple[str, ...] = ()
    bound: bool = False
    stored: bool = False


def entry(key: str, value: str) -> Lever:
    """Return the lever of one entry of the session's configuration."""
    return Lever(lambda options: options.add_session_config_entry(key, value))


def attribute(name: str, value: object) -> Lever:
    """Return the lever of one attribute of the session's options."""
    return Lever(lambda options: setattr(options, name, value))


LEVERS = {
    "SkipLayerNormalization fused": Lever(made=SLOW_FUSIONS),
    "level basic": attribute("graph_optimization_level", LEVELS.ORT_ENABLE_BASIC),
    "level extended": attribute("graph_optimization_level", LEVELS.ORT_ENABLE_EXTENDED),
    "level none": attribute("graph_optimization_level", LEVELS.ORT_DISABLE_ALL),
    "IO binding": Lever(bound=True),
    "memory pattern": attribute("enable_mem_pattern", True),
    "no memory arena": attribute("enable_cpu_mem_arena", False),
    "threads spin": entry("session.intra_op.allow_spinning", "1"),
    "dynamic blocks of work": entry("session.dynamic_block_base", "4"),
    "priority-based order": attribute(
        "execution_order", ort.ExecutionOrder.PRIORITY_BASED
    ),
    "prepacking off": entry("session.disable_prepacking", "1"),
    "NCHWc layout off": Lever(left_out=("NchwcTransformer",)),
    "NHWC layout off": Lever(left_out=("NhwcTransformer",)),
    "approximate GELU": entry("optimization.enable_gelu_approximation", "1"),
    "bfloat16 products (ARM)": entry("mlas.enable_gemm_fastmath_arm64_bfloat16", "1"),
    "int8 pairs not fused": entry("session.disable_quant_qdq", "1"),
    "int8 without overflow": entry("session.x64quantprecision", "1"),
    "onnxruntime's own format": Lever(stored=True),
}
"""By what the table calls it; `int8` ones change nothing in a float graph."""


def options_of(threads: int, lever: Lever) -> ort.SessionOptions:
    """Return the options of our sessions, one setting apart."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    lever.change(options)
    return options


def stored(model: Path, threads: int, lever: Lever) -> Path:
    """Return a file in onnxruntime's own format; others are as they are."""
    if not lever.stored:
        return model
    options, path = options_of(threads, lever), model.with_suffix(".ort")
    options.optimized_model_filepath = str(path)
    options.add_session_config_entry("session.save_model_format", "ORT")
    _session(model, options, lever)
    return path


def opened(model: Path, threads: int, lever: Lever) -> ort.InferenceSession:
    """Open a graph as our sessions do, one setting apart."""
    path = stored(model, threads, lever)
    return _session(path, options_of(threads, lever), lever)


def _session(
    model: Path, options: ort.SessionOptions, lever: Lever
) -> ort.InferenceSession:
    kept = [each for each in CPU.left_out if each not in lever.made]
    return ort.InferenceSession(
        str(model),
        options,
        providers=[CPU.native],
        disabled_optimizers=[*kept, *lever.left_out],
    )


def runner(session: ort.InferenceSession, feeds: Feeds, lever: Lever) -> Run:
    """Return what runs one frame."""
    if not lever.bound:
        return lambda: session.run(None, dict(feeds))
    binding = session.io_binding()
    for name, array in feeds.items():
        binding.bind_ortvalue_input(name, ort.OrtValue.ortvalue_from_numpy(array))
    for port in session.get_outputs():
        binding.bind_output(port.name, "cpu")
    return lambda: session.run_with_iobinding(binding)


def measured(
    model: Path, feeds: Feeds, lever: Lever, *, threads: int, rounds: int
) -> tuple[Cost, Cost]:
    """Return what our session takes, and the other, in turn."""
    levers = Lever(), lever
    paths = [stored(model, threads, each) for each in levers]
    opening: list[list[float]] = [[], []]
    runs: list[Run] = []
    for _ in range(2):
        runs.clear()
        for path, each, seconds in zip(paths, levers, opening, strict=True):
            begun = time.process_time()
            session = _session(path, options_of(threads, each), each)
            seconds.append(time.process_time() - begun)
            runs.append(runner(session, feeds, each))
    taken = in_turn(dict(zip(("ours", "other"), runs, strict=True)), rounds).values()
    ours, other = map(Cost, map(min, taken), map(min, opening))
    return ours, other


def first_frame(model: Path, recording: Path) -> Feeds:
    """Read the first frame; what it lacks is zeros."""
    frame = next(iter(CalibrationSet(recording)))
    ports = Session(model, threads=1).inputs
    return {
        name: np.ascontiguousarray(frame.arrays[name])
        if name in frame.arrays
        else np.zeros([int(str(size)) for size in port.shape], DTYPES[port.type])
        for name, port in ports.items()
    }


def main() -> None:
    """Measure every lever and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("frames", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    feeds = first_frame(given.model, given.frames)
    chosen = list(filter(None, given.only.split(";"))) or list(LEVERS)
    print(
        f"{given.model.name}: {processor()}, {given.threads} threads, onnxruntime"
        f" {ort.__version__}, least of {given.rounds}\n"
    )
    print("| setting | ours, CPU s | with it | ratio | opening |")
    print("|---|---:|---:|---:|---:|")
    for name in chosen:
        print(row(name, given, feeds), flush=True)


def row(name: str, given: argparse.Namespace, feeds: Feeds) -> str:
    """Measure one lever and write its row; onnxruntime may refuse the graph with it."""
    try:
        ours, other = measured(
            given.model,
            feeds,
            LEVERS[name],
            threads=given.threads,
            rounds=given.rounds,
        )
    except REFUSALS as error:
        return f"| {name} | refused: {' '.join(str(error).split())[-100:]} | | | |"
    ratio, opening = other.run / ours.run, other.opening / ours.opening
    cells = (ours.run, other.run, ratio, opening)
    return f"| {name} | {' | '.join(f'{each:.2f}' for each in cells)} |"


if __name__ == "__main__":
    main()
