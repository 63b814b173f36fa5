"""Trained networks of public packages, compressed by this toolkit and by others.

    python -m benchmarks.measure.real_files OUT [--only PART] [--tools ours,...]
        [--rounds 3]

Five pinned packages are installed into OUT/packages, onnxsim and onnxslim into
OUT/peers; nothing of them is kept anywhere else. Of files that are one network with
other weights the first is taken, of trees none: they have no layer. Each network is
compressed with 16 frames drawn by one seed and judged on 16 of another, against its
source run without any optimization. A line of JSON for a network and a tool is added to
OUT/records.jsonl; what stands there is not measured again, so a run that ended goes on.

What `compress` prints of an output is held against fresh frames, each figure against
its own kind: the dB over all frames kept out of calibration against those over all
fresh ones, and the noisiest frame of the recording against the noisiest of as many
fresh ones. Neither can be nearer than two sets of fresh frames are to each other: that
is counted beside it, on 16 frames of a third seed. What is promised is the noisiest,
also of frames to come: of n frames one in n + 1 to come is noisier.

Columns: nodes; MB; dB of the worst output on fresh frames, what was reported of it, by
how much an output's report is off most; the same three of the noisiest frame, and how
many fresh frames are noisier than that; CPU time as a share of the source's, both in
onnxruntime on one thread, a process each, in turn.
"""

import argparse
import hashlib
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import onnx
import onnxruntime

from benchmarks.subjects.real_frames import MAKERS, Frame, opened
from benchmarks.tools.processes import answer, last_line
from me2e_compress import graph
from me2e_compress.passes.freeze_inputs import deciding_inputs

PACKAGES = (
    "rapidocr-onnxruntime==1.4.4",
    "silero-vad==6.2.3",
    "magika==1.0.3",
    "atspm-detector==1.1.0",
    "speechmos==0.0.1.1",
)
PEERS = ("onnxsim==0.8.1", "onnxslim==0.1.98")
OURS = {
    "exact": ("-r", "exact"),
    "ours": ("-r", "full", "--target", "onnxruntime"),
    "ours for TensorRT": ("-r", "full", "--target", "tensorrt"),
}
TOOLS = (*OURS, "onnxsim", "onnxslim", "quantize_static")
COLUMNS = "file | tool | nodes | MB | dB | reported | off | noisiest | reported | off"
COLUMNS += " | noisier | time"
FRAMES = 16
"""Frames that are compressed with, and so many others that are judged on."""

Answers: TypeAlias = dict[str, list[Any]]
"""Outputs by name, a list over frames."""
Figures: TypeAlias = dict[str, dict[str, float]]
"""By output the dB over all frames, ``mean``, and in the ``noisiest`` of them."""

COMMAND = "import sys; from me2e_compress.cli import main; sys.exit(main())"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default="", help="part of the file's path")
    parser.add_argument("--tools", default=",".join(TOOLS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--records", default="records.jsonl", help="file in OUT")
    parser.add_argument(
        "--child", choices=("quantize_static", "onnxsim", "onnxslim", "time")
    )
    parser.add_argument("--file", type=Path)
    options = parser.parse_args()
    if options.child == "time":
        print(json.dumps(cpu_seconds(options.file, options.out)))
        return
    if options.child:
        PEER_WORK[options.child](options.file, options.out)
        return
    install(options.out / "packages", PACKAGES)
    install(options.out / "peers", PEERS)
    records = options.out / options.records
    for model in networks(options.out / "packages"):
        if options.only in str(model):
            measure(
                model, options.tools.split(","), options.out, records, options.rounds
            )
    for line in table(read(records)):
        print(line)


def install(folder: Path, packages: Iterable[str]) -> None:
    """Install packages alone, without what they need, into a folder."""
    if not folder.is_dir():
        command = [
            sys.executable,
            "-m",
            "pip",
            "install",
            "-q",
            "--no-deps",
            "-t",
            folder,
        ]
        subprocess.run([*map(str, command), *packages], check=True)


def networks(folder: Path) -> Iterator[Path]:
    """Yield one file of each network for which frames can be made."""
    forms = set[str]()
    for path in sorted(folder.rglob("*.onnx")):
        if not any(part in str(path) for part in MAKERS):
            continue
        model = onnx.load(path)
        nodes = [(node.op_type, node.name, *node.input) for node in model.graph.node]
        weights = [(each.name, *each.dims) for each in model.graph.initializer]
        form = hashlib.sha256(repr((nodes, weights)).encode()).hexdigest()
        if form not in forms:
            forms.add(form)
            yield path


def frames_of(model: Path, seed: int) -> list[Frame]:
    """Draw a network's frames."""
    maker = next(make for part, make in MAKERS.items() if part in str(model))
    return list(islice(maker(model, np.random.default_rng(seed)), FRAMES))


def save(frames: Iterable[Frame], folder: Path) -> None:
    """Write a recording with four frames a scene."""
    folder.mkdir(parents=True, exist_ok=True)
    for place, frame in enumerate(frames):
        np.savez(folder / f"{place:06d}.npz", **frame)  # type: ignore[arg-type]
    scenes = {"scenes": list(range(0, FRAMES, 4))}
    (folder / "scenes.json").write_text(json.dumps(scenes))


def measure(
    model: Path, tools: list[str], out: Path, records: Path, rounds: int
) -> None:
    """Make what the records lack of a network, and judge it."""
    name = str(model.relative_to(out / "packages"))
    known = {row["tool"] for row in read(records) if row["file"] == name}
    missing = [tool for tool in tools if tool not in known]
    if not missing:
        return
    work = out / "work" / name.replace("/", "+")
    recording, source = frames_of(model, 0), opened(model)
    save(recording, work / "frames")
    fresh = {
        "fresh": (frames := frames_of(model, 1), answers(source, frames)),
        "again": (frames := frames_of(model, 2), answers(source, frames)),
    }
    rows = list[dict[str, Any]]()
    for tool in missing:
        row: dict[str, Any] = {"file": name, "tool": tool, "error": ""}
        made = work / f"{tool.replace(' ', '-')}.onnx"
        started = time.monotonic()
        row["error"] = run_tool(tool, model, recording[0], made)
        row["seconds"] = time.monotonic() - started
        if not row["error"]:
            row |= judged(model, made, fresh)
        rows.append(row)
    # the time of all beside the source's
    files = {
        row["tool"]: work / f"{row['tool'].replace(' ', '-')}.onnx" for row in rows
    }
    files = {tool: path for tool, path in files.items() if path.is_file()}
    taken = timed({"source": model, **files}, work / "frames", rounds)
    with records.open("a") as file:
        for row in rows:
            if not row["error"] and row["tool"] in taken:
                row["ratio"] = taken[row["tool"]] / taken["source"]
            file.write(json.dumps(row) + "\n")
            print(shown(row), flush=True)


def run_tool(tool: str, model: Path, frame: Frame, made: Path) -> str:
    """Let a tool write its file; return why it did not, or nothing."""
    made.unlink(missing_ok=True)
    if tool in OURS:
        if names := deciding_inputs(graph.load(model)):
            model = frozen(model, names, made)
        command = [sys.executable, "-c", COMMAND, "compress", model, *OURS[tool]]
        command += ["--frames", made.parent / "frames", "-o", made, "--force"]
        command += [
            word for size in open_sizes(model, frame) for word in ("--set-dim", size)
        ]
    else:
        command = [sys.executable, "-m", "benchmarks.measure.real_files", made]
        command += ["--child", tool, "--file", model]
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False
    )
    made.with_suffix(".log").write_text(done.stdout + done.stderr)
    return "" if done.returncode == 0 else last_line(done) or f"exit {done.returncode}"


def frozen(model: Path, names: tuple[str, ...], made: Path) -> Path:
    """Make flags constants, as inspect advises; return the file."""
    passes = f"import-normalize,freeze-inputs{{inputs=[{','.join(names)}]}}"
    output = made.with_name("frozen.onnx")
    command = [sys.executable, "-c", COMMAND, "compress", str(model), "--force"]
    command += ["--passes", f"{passes},fold-constants", "-o", str(output)]
    command += ["--frames", str(made.parent / "frames")]
    done = subprocess.run(command, capture_output=True, check=False)
    return output if done.returncode == 0 else model


def open_sizes(model: Path, frame: Frame) -> list[str]:
    """Return what fixes the sizes that a network leaves open, as INPUT:AXIS=SIZE."""
    sizes = list[str]()
    for port in opened(model).get_inputs():
        for axis, size in enumerate(port.shape):
            if not isinstance(size, int) or size < 1:
                sizes.append(f"{port.name}:{axis}={frame[port.name].shape[axis]}")
    return sizes


def answers(session: onnxruntime.InferenceSession, frames: list[Frame]) -> Answers:
    """Run frames; return the outputs by name, a list over frames."""
    names = [port.name for port in session.get_outputs()]
    taken = [port.name for port in session.get_inputs()]
    rows = [
        session.run(None, {name: frame[name] for name in taken}) for frame in frames
    ]
    return {name: [row[place] for row in rows] for place, name in enumerate(names)}


def judged(
    model: Path, made: Path, fresh: dict[str, tuple[list[Frame], Answers]]
) -> dict[str, Any]:
    """Return size, nodes and decibels of a file that a tool wrote."""
    session, row = None, dict[str, Any]()
    for name, (frames, truth) in fresh.items():
        try:
            session = session or opened(made)
            answered = answers(session, frames)
        except Exception as error:  # whatever onnxruntime says of a peer's file
            return {"error": f"does not run: {str(error).splitlines()[0][:120]}"}
        row[name] = figures(truth, answered)
        if name == "fresh":
            row["frames"] = {out: by_frame(truth[out], answered[out]) for out in truth}
    row["worst"] = min(row["fresh"], key=lambda name: row["fresh"][name]["mean"])
    row["nodes"] = [count_nodes(model), count_nodes(made)]
    row["mb"] = [model.stat().st_size / 1e6, made.stat().st_size / 1e6]
    # what was measured when it was written
    report = made.with_suffix(".report.json")
    if report.is_file() and (loss := json.loads(report.read_text())["fidelity"]):
        outputs = (loss["fidelity"] or {"outputs": ()})["outputs"]
        means = {each["name"]: limited(each["sqnr_db"]) for each in outputs}
        row["reported"] = {
            each["name"]: {
                "mean": means[each["name"]],
                "noisiest": limited(each["least_db"], means[each["name"]]),
            }
            for each in outputs
        }
    return row


def limited(decibels: float | None, otherwise: float = 200.0) -> float:
    """Return decibels of a report, which writes null for infinite or none."""
    return otherwise if decibels is None else decibels


def count_nodes(model: Path) -> int:
    """Count the nodes of a file, those of branches too, without constants."""

    def walk(body: onnx.GraphProto) -> int:
        inner = [
            each.g
            for node in body.node
            for each in node.attribute
            if each.HasField("g")
        ]
        own = sum(node.op_type != "Constant" for node in body.node)
        return own + sum(map(walk, inner))

    return walk(onnx.load(model).graph)


def figures(truth: Answers, answered: Answers) -> Figures:
    """Return the dB of each output over all frames, and in the noisiest."""
    return {
        name: {
            "mean": decibels(truth[name], answered[name]),
            "noisiest": min(by_frame(truth[name], answered[name])),
        }
        for name in truth
    }


def decibels(truth: list[Any], answered: list[Any]) -> float:
    """Return the signal to noise ratio over all frames, 200 dB at most."""
    return ratio_db(sum(map(energy, truth)), sum(noises(truth, answered)))


def by_frame(truth: list[Any], answered: list[Any]) -> list[float]:
    """Return the dB of each frame's noise, against the mean signal of all."""
    signal = sum(map(energy, truth)) / len(truth)
    return [ratio_db(signal, noise) for noise in noises(truth, answered)]


def noises(truth: list[Any], answered: list[Any]) -> list[float]:
    """Return the energy of the noise of each frame."""
    return [
        energy(np.asarray(a, np.float64) - np.asarray(b, np.float64))
        for a, b in zip(truth, answered, strict=True)
    ]


def energy(array: Any) -> float:
    """Return the sum of squares."""
    values = np.asarray(array, np.float64).ravel()
    return float(values @ values)


def ratio_db(signal: float, noise: float) -> float:
    """Return a ratio of energies in dB, 200 at most."""
    return float(min(200.0, 10 * np.log10(max(signal, 1e-300) / max(noise, 1e-300))))


def timed(files: dict[str, Path], frames: Path, rounds: int) -> dict[str, float]:
    """Return the least CPU seconds a frame of each file, a process each, in turn."""
    taken = dict[str, float]()
    for _ in range(rounds):
        for name, path in files.items():
            command: list[str | Path]
            command = [sys.executable, "-m", "benchmarks.measure.real_files", frames]
            seconds = answer([*command, "--child", "time", "--file", path])
            if isinstance(seconds, dict):
                taken[name] = min(taken.get(name, np.inf), seconds["cpu_s"])
    return taken


def cpu_seconds(model: Path, frames: Path) -> dict[str, float]:
    """Time a file on its first frame, as anybody opens it: the least of ten or more."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    session = onnxruntime.InferenceSession(
        model, options, providers=["CPUExecutionProvider"]
    )
    with np.load(frames / "000000.npz") as arrays:
        frame = {port.name: arrays[port.name] for port in session.get_inputs()}
    session.run(None, frame)
    spent, begun = list[float](), time.perf_counter()
    while len(spent) < 10 or time.perf_counter() - begun < 0.5:
        start = time.process_time()
        session.run(None, frame)
        spent.append(time.process_time() - start)
    return {"cpu_s": min(spent)}


def quantize_static(model: Path, made: Path) -> None:
    """Quantize as onnxruntime does by default: QDQ, of the same frames."""
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat
    from onnxruntime.quantization import quantize_static as quantize

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            taken = [port.name for port in opened(model).get_inputs()]
            files = sorted((made.parent / "frames").glob("*.npz"))
            frames = [dict(np.load(file)) for file in files]
            self.left = iter(
                [{name: frame[name] for name in taken} for frame in frames]
            )

        def get_next(self) -> Any:
            return next(self.left, None)

    quantize(str(model), str(made), Reader(), quant_format=QuantFormat.QDQ)


def simplify(model: Path, made: Path) -> None:
    sys.path.insert(0, str(made.parents[2] / "peers"))
    import onnxsim

    simplified, _ = onnxsim.simplify(onnx.load(model))
    onnx.save(simplified, made)


def slim(model: Path, made: Path) -> None:
    sys.path.insert(0, str(made.parents[2] / "peers"))
    import onnxslim

    slimmed: Any = onnxslim.slim(onnx.load(model))
    onnx.save(slimmed, made)


PEER_WORK = {"quantize_static": quantize_static, "onnxsim": simplify, "onnxslim": slim}


def read(records: Path) -> list[dict[str, Any]]:
    """Return the rows that were measured."""
    if not records.is_file():
        return []
    return [json.loads(line) for line in records.read_text().splitlines()]


def gaps(row: dict[str, Any], name: str, kind: str, of: str = "") -> list[float]:
    """Return by how much figures exceed those of a kind on fresh frames, by output."""
    fresh = row["fresh"]
    return [
        each[kind] - fresh[output][of or kind]
        for output, each in row.get(name, {}).items()
    ]


def noisier(row: dict[str, Any]) -> list[int]:
    """Count the fresh frames noisier than what is reported, for each output."""
    reported = row.get("reported", {}).items()
    return [
        sum(frame < each["noisiest"] for frame in row["frames"][output])
        for output, each in reported
    ]


def shown(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    short = row["file"].rsplit("/", 1)[-1].removesuffix(".onnx")
    if row["error"]:
        return f"{short} | {row['tool']} | {row['error']}"
    nodes, mb, worst = row["nodes"], row["mb"], row["worst"]
    cells = [short, row["tool"], f"{nodes[0]} {nodes[1]}", f"{mb[0]:.2f} {mb[1]:.2f}"]
    for kind in ("mean", "noisiest"):
        cells.append(f"{row['fresh'][worst][kind]:.1f}")
        off = max(gaps(row, "reported", kind), key=abs, default=None)
        reported = "reported" in row and off is not None
        cells.append(f"{row['reported'][worst][kind]:.1f}" if reported else "")
        cells.append("" if off is None else f"{off:+.1f}")
    cells.append(str(max(noisier(row), default="")))
    cells.append(f"{row['ratio']:.2f}" if "ratio" in row else "")
    return " | ".join(cells)


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield all rows, and how many meet what is asked of them."""
    yield COLUMNS
    yield re.sub("[^|]+", "---", COLUMNS)
    yield from map(shown, rows)
    ours = [row for row in rows if row["tool"] in OURS and not row["error"]]
    refused = [row for row in rows if row["tool"] in OURS and row["error"]]
    peer = {row["file"]: row for row in rows if row["tool"] == "quantize_static"}
    int8 = [row for row in ours if row["tool"] == "ours"]
    behind = [
        row["file"]
        for row in int8
        if (other := peer.get(row["file"])) and not other["error"]
        # what is equal to its source has no int8
        if worst_db(row) < worst_db(other) < 200
    ]
    yield f"refused: {len(refused)}"
    reports = [row for row in ours if row.get("reported")]
    for kind in ("mean", "noisiest"):
        for name, whose in (("reported", "reported"), ("again", "other fresh frames")):
            off = [gaps(row, name, kind) for row in reports]
            near = sum(max(map(abs, each)) <= 3 for each in off)
            above = sum(max(each) > 6 for each in off)
            yield (
                f"{kind}, {whose}: within 3 dB of fresh frames' {near} of {len(off)},"
                f" more than 6 dB above {above}"
            )
    off = [gaps(row, "reported", "noisiest", of="mean") for row in reports]
    above = sum(max(each) > 6 for each in off)
    yield f"noisiest reported more than 6 dB above fresh frames' mean: {above}"
    counts = [each for row in reports for each in noisier(row)]
    expected = FRAMES * len(counts) / (FRAMES + 1)
    yield (
        f"fresh frames noisier than the noisiest reported: {sum(counts)} of"
        f" {FRAMES * len(counts)}, {expected:.0f} expected"
    )
    slower = sum(row.get("ratio", 1) > 1.05 for row in int8)
    larger = sum(row["mb"][1] > row["mb"][0] for row in ours)
    yield f"slower than their source: {slower}; larger: {larger}"
    yield f"worst output behind quantize_static's: {', '.join(behind) or 'none'}"


def worst_db(row: dict[str, Any]) -> float:
    """Return the dB of the worst output over all fresh frames."""
    return float(row["fresh"][row["worst"]]["mean"])


if __name__ == "__main__":
    main()
