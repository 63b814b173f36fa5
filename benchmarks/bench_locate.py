"""Seeded faults in a driving model: does `compare --first-difference` name the node?

    me2e-compress export vad-tiny -o vad/source.onnx
    me2e-compress compress vad/source.onnx -r exact -o vad/exact.onnx
    me2e-compress frames vad-tiny -n 1 -o vad/frames
    python -m benchmarks.bench_locate vad/source.onnx vad/exact.onnx vad/frames \\
        vad/faults.jsonl --faults 50

Every fault (:mod:`benchmarks.wrong_nodes`) is seeded into the exact form, in which
nodes are fused, renamed and moved. It is held against the source in turn with the exact
form itself. A fault that moves no value beyond rounding on these frames is counted as
silent, and another one is drawn. Each line of the output is a fault; those that are
there already are not done again. A fault of VAD-tiny takes 17 CPU s; with
``--sections N`` the graph is cut into N sections of consecutive nodes, which get what
the whole graph computes there, and each fault is looked for in its section alone.
"""

import argparse
import dataclasses
import json
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import onnx_ir as ir

from benchmarks.wrong_nodes import seed_fault
from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import Me2eError
from me2e_compress.fidelity.first_difference import FirstDifference, Source
from me2e_compress.fidelity.run_alone import Truth
from me2e_compress.fidelity.values import first_state
from me2e_compress.graph.part import part_of
from me2e_compress.manager.reproducer import window
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU


@dataclasses.dataclass(frozen=True)
class Section:
    """The exact form or some of its nodes, what they are fed, and the source of them.

    Attributes:
        name: which of how many.
        exact: where faults are seeded.
        source: the part of the source between values of the same names; None where it
            has none.
        frames: what both read.
    """

    name: str
    exact: ir.Model
    source: ir.Model | None
    frames: Sequence[Frame]


def run(given: argparse.Namespace) -> None:
    """Draw faults until enough are not silent; write one line each."""
    done = _read(given.out)
    seed = max((row["seed"] for row in done), default=-1)
    for at, section in enumerate(_sections(given)):
        count = given.sections
        wanted = given.faults * (at + 1) // count - given.faults * at // count
        mine = [row for row in done if row["section"] == section.name]
        if _told(mine) >= wanted:
            continue
        models = {"source": section.source, "exact": section.exact}
        sources = {
            name: Source.of(model, section.frames)
            for name, model in models.items()
            if model is not None
        }
        usual = dict[str, int]()  # values of another meaning: without a fault, too
        for name, source in sources.items():
            found = source.first_difference(section.exact)
            usual[name] = found.different
            told = f"section {section.name}, {name}, no fault: {_line(found)}"
            print(told if found.first is None else f"{told}: FALSE ALARM", flush=True)
        while _told(mine) < wanted:
            seed += 1
            against = list(sources)[seed % len(sources)]
            row = _try(section.exact, sources[against], usual[against], seed)
            named = {"seed": seed, "section": section.name, "against": against}
            mine.append({**named, **row})
            with given.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(mine[-1]) + "\n")


def _told(rows: Sequence[Mapping[str, Any]]) -> int:
    return sum(row["outcome"] != "silent" for row in rows)


def _sections(given: argparse.Namespace) -> Iterator[Section]:
    """Open both graphs, and cut them into sections of consecutive nodes."""
    frames = list(CalibrationSet(given.frames))[: given.most_frames]
    source, exact = graph.load(given.source), graph.load(given.exact)
    for model in (source, exact):
        graph.infer_shapes(model)
    count = given.sections
    if count == 1:
        yield Section("1/1", exact, source, frames)
        return
    # what the sections read is computed once
    size = -(-len(exact.graph) // count)
    parts = [window(exact, at * size, (at + 1) * size) for at in range(count)]
    known = _computed(exact, frames[0], [each for each in parts if each is not None])
    for at, part in enumerate(parts):
        if part is None:
            raise SystemExit(f"section {at + 1} reads or gives a value of open shape")
        reads = {str(value.name): known[str(value.name)] for value in part.graph.inputs}
        their = _part_of_source(source, part)
        for model in filter(None, (part, their)):
            model.metadata_props["me2e.recurrent"] = "{}"
        yield Section(f"{at + 1}/{count}", part, their, [Frame(0, True, reads)])


def _computed(
    exact: ir.Model, frame: Frame, parts: Sequence[ir.Model]
) -> Mapping[str, Array]:
    given = {**frame.arrays, **first_state(exact, frame)}
    reads = [str(value.name) for each in parts for value in each.graph.inputs]
    made = [name for name in dict.fromkeys(reads) if name not in given]
    return {**given, **Truth(exact, [given], CPU).arrays(made, 0)}


def _part_of_source(source: ir.Model, part: ir.Model) -> ir.Model | None:
    values = ir.convenience.create_value_mapping(source.graph)
    try:
        reads, gives = (
            [values[str(value.name)] for value in each]
            for each in (part.graph.inputs, part.graph.outputs)
        )
        return part_of(source, reads, gives)
    except (KeyError, ValueError):
        return None


def _try(exact: ir.Model, source: Source, usual: int, seed: int) -> dict[str, Any]:
    candidate, start = exact.clone(), time.process_time()
    fault = seed_fault(candidate, seed)
    row: dict[str, Any] = {"kind": fault.kind, "nodes": fault.nodes}
    try:
        found = source.first_difference(candidate)
    except Me2eError as error:  # onnxruntime refuses what the fault made
        return {**row, "outcome": "silent", "why": str(error)[:200]}
    first = found.first or next(iter(found.places), None)
    row["module"] = fault.module
    row["different"], row["compared"] = found.different, found.compared
    row["cpu_s"] = round(time.process_time() - start, 1)
    if found.first is None and found.different <= usual:
        return {**row, "outcome": "silent"}
    if first is None or not set(fault.nodes) & set(first.nodes):
        row["named"] = _line(found)
        return {**row, "outcome": "missed"}
    row["module named"] = first.module
    row["place"], row["own_db"] = len(first.nodes), first.own_db
    return {**row, "outcome": "found"}


def _line(found: FirstDifference) -> str:
    places = "; ".join(f"{each.value} of {each.nodes[-3:]}" for each in found.places)
    told = places or "-"
    return (
        f"{found.different} of {found.compared} values below {found.floor_db:g} dB,"
        f" {found.unknown} unknown, {found.inherited} inherited; places: {told}"
    )


def show(out: Path) -> None:
    """Print what was found, by kind."""
    rows = _read(out)
    count = Counter((row["kind"], row["outcome"]) for row in rows)
    print(f"{'':16} found missed silent")
    for kind in sorted({row["kind"] for row in rows}):
        cells = [count[kind, outcome] for outcome in ("found", "missed", "silent")]
        print(f"{kind:16} {cells[0]:5} {cells[1]:6} {cells[2]:6}")
    found = [row for row in rows if row["outcome"] == "found"]
    alone = sum(row["place"] == 1 for row in found)
    largest = max((row["place"] for row in found), default=0)
    right = sum(row["module"] == row["module named"] for row in found)
    print(
        f"{len(found)} found: {alone} as a single node, the longest stretch {largest};"
        f" the module was right {right} times"
    )


def _read(out: Path) -> list[Mapping[str, Any]]:
    if not out.exists():
        return []
    return [json.loads(line) for line in out.read_text("utf-8").splitlines()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("source", "exact", "frames", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--faults", type=int, default=50)
    parser.add_argument("--most-frames", type=int, default=1)
    parser.add_argument("--sections", type=int, default=1)
    given = parser.parse_args()
    run(given)
    show(given.out)


if __name__ == "__main__":
    main()
