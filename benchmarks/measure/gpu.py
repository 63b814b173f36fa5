"""The driver and VAD-tiny on every provider of onnxruntime that is installed here.

    python -m benchmarks.measure.gpu OUT [--providers cpu,cuda,tensorrt]
        [--subjects highway,vad-tiny] [--plugins LIB --dialect tensorrt] [--frames N]
        [--runs 200] [--seconds 60] [--warm-up 20] [--threads 0] [--no-energy]

One frame, recurrent state at zeros, a process a row, alone: nothing else may run on the
device. Files are those that the provider wants: int8 is placed for TensorRT where that
runs it, else as onnxruntime's own kernels want it, which CUDA has not: there it runs in
float. With the library of a dialect (``--plugins``, ``--dialect``) deformable attention
runs as that library's plugin too; without, TensorRT gets it in standard operators.

The table gives the median and the 99th percentile over so many runs on the clock, the
memory that the device had in use more than before (NVML, whoever took it), the largest
resident set, the least signal to noise over the outputs and that of the plan against
onnxruntime's CPU on the file as exported, and joules a frame by the counter of that
device (a minute and a half a row). What is not installed is a row that says what to
install; "-" was not measured, for a reason below the table.

Files and rows stay in OUT; run again, it goes on. OUT/table.md holds the tables.
"""

import argparse
import dataclasses
import hashlib
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from benchmarks.measure.runtime import sqnr_db
from benchmarks.subjects import subjects
from benchmarks.subjects.runtime_files import (
    BEFORE,
    FUSED,
    REFERENCE,
    Entry,
    first_frame,
    made,
    path_of,
)
from benchmarks.subjects.subject import Subject
from benchmarks.tools import processes
from benchmarks.tools.gpu_table import Found, write
from me2e_compress import graph
from me2e_compress.base.atomic import write_json
from me2e_compress.base.errors import ProviderError
from me2e_compress.runtime.providers import CPU, PROVIDERS, Provider, provider_named

FRAMES = {"highway": 64, "vad-tiny": 2}
"""To calibrate on, unless told otherwise: VAD-tiny takes 3 CPU seconds a frame."""
EXACT = f"{BEFORE},fuse-basic"


@dataclasses.dataclass(frozen=True)
class Row:
    """One file on one provider.

    Attributes:
        file: its name in the folder; ``{target}`` is that of the provider's int8.
        passes: that make it; the same.
        precision: of TensorRT, which onnxruntime sets for the whole engine.
        flags: of :mod:`benchmarks.tools.run_on_provider`.
        on: targets whose providers run it; empty for all.
        plugin: whether it needs the library of a dialect.
    """

    file: str
    passes: str = ""
    precision: str = "fp32"
    flags: tuple[str, ...] = ()
    on: tuple[str, ...] = ()
    plugin: bool = False


INT8 = "quantize-int8{{target={target}}}"
AS_PLUGINS = "translate-plugins{{dialect={dialect}}}"
TENSORRT = ("tensorrt",)
ROWS = {
    REFERENCE: Row("source", flags=("--stock",)),
    "exact": Row("exact", EXACT),
    "exact, inputs and outputs on the device": Row("exact", EXACT, flags=("--bound",)),
    "fused": Row("fused", FUSED),
    "float16": Row("float16", f"{EXACT},convert-float16", "fp16"),
    "int8": Row("int8-{target}", f"{EXACT},{INT8}", "int8"),
    "int8, float16 where faster": Row(
        "int8-{target}", f"{EXACT},{INT8}", "best", on=TENSORRT
    ),
    "int8 fused": Row("int8-fused-{target}", f"{FUSED},{INT8}", "int8"),
    "fused, as plugins": Row(
        "plugins-{dialect}", f"{FUSED},{AS_PLUGINS}", on=TENSORRT, plugin=True
    ),
    "int8 fused, as plugins": Row(
        "int8-plugins-{dialect}",
        f"{FUSED},{INT8},{AS_PLUGINS}",
        "int8",
        on=TENSORRT,
        plugin=True,
    ),
}


class Bench:
    """Runs rows of one subject, and keeps them."""

    def __init__(
        self, subject: Subject, frames: int, given: argparse.Namespace
    ) -> None:
        self.subject, self.frames, self.given = subject, frames, given
        self.frame = first_frame(subject)

    def rows(self, provider: Provider) -> Iterator[Found]:
        """Measure every row on a provider, the reference first."""
        for name, row in ROWS.items():
            if row.on and provider.target not in row.on:
                continue
            yield self.found(provider, name, row)

    def found(self, provider: Provider, name: str, row: Row) -> Found:
        """Return what is kept of a row, or measure it."""
        empty = Found(self.subject.name, provider.name, name)
        if row.plugin and not self.given.plugins:
            lacks = "needs --plugins LIB --dialect D, a library of TensorRT plugins"
            return dataclasses.replace(empty, reason=lacks)
        entry, runs = self._entry(provider, row), self._provider(provider, row)
        reason = made(self.subject, entry, self.frames)
        if reason is not None:
            return dataclasses.replace(empty, reason=f"not made: {reason}")
        path = path_of(self.subject, entry)
        place = self.subject.folder / "rows" / f"{provider.name} {name}.json"
        key = self._key(path, runs, row)
        measured = self._kept(place, key)
        if measured is None:
            print(f"  {self.subject.name}, {provider.name}: {name}", file=sys.stderr)
            answer = self._measure(path, runs, row, place)
            if isinstance(answer, str):
                return dataclasses.replace(empty, reason=answer)
            measured = answer
            write_json(place, {"key": key, "measured": measured})
        size = graph.file_bytes(path) / 1e6
        return dataclasses.replace(empty, megabytes=size, measured=measured)

    def _entry(self, provider: Provider, row: Row) -> Entry:
        words = {"target": provider.target, "dialect": self.given.dialect}
        return Entry("ours", row.file.format(**words), row.passes.format(**words))

    def _provider(self, provider: Provider, row: Row) -> Provider:
        """Return the provider as a row wants it: engines are kept, precision is set."""
        changes: dict[str, Any] = {}
        known = {field.name for field in dataclasses.fields(provider)}
        if "precision" in known:
            changes["precision"] = row.precision
        if "cache" in known:
            changes["cache"] = (self.subject.folder / "engines").absolute()
            changes["cache"].mkdir(exist_ok=True)
        if row.plugin:
            changes["plugins"] = tuple(self.given.plugins)
        return dataclasses.replace(provider, **changes)

    def _key(self, path: Path, provider: Provider, row: Row) -> str:
        """Name everything that decides what is measured."""
        given = self.given
        how = (given.runs, given.seconds, given.warm_up, given.threads, given.energy)
        known = (graph.sha256_of(path), ort.__version__, PROVIDERS.text(provider))
        return hashlib.sha256(repr((known, row.flags, how)).encode()).hexdigest()

    def _kept(self, place: Path, key: str) -> dict[str, Any] | None:
        if not place.is_file():
            return None
        kept: dict[str, Any] = json.loads(place.read_bytes())
        if kept["key"] != key or not self._reference.is_file():
            return None
        measured: dict[str, Any] = kept["measured"]
        return measured

    @property
    def _reference(self) -> Path:
        return self.subject.folder / "rows" / f"{CPU.name} {REFERENCE}.npz"

    def _measure(
        self, path: Path, provider: Provider, row: Row, place: Path
    ) -> dict[str, Any] | str:
        """Run a row in a process of its own; return why it did not, if so."""
        place.parent.mkdir(exist_ok=True)
        answers, given = place.with_suffix(".npz"), self.given
        command = [
            sys.executable,
            "-W",
            "ignore",
            "-m",
            "benchmarks.tools.run_on_provider",
        ]
        command += [str(path), str(self.frame), str(answers), *row.flags]
        command += ["--provider", PROVIDERS.text(provider)]
        command += ["--energy"] if given.energy else []
        for name in ("runs", "seconds", "warm_up", "threads"):
            command += [f"--{name.replace('_', '-')}", str(getattr(given, name))]
        found = processes.answer(command)
        if isinstance(found, str):
            return found
        with np.load(self._reference) as wanted, np.load(answers) as got:
            wild = [name for name in got if not np.isfinite(got[name]).all()]
            noise = {name: sqnr_db(wanted[name], got[name]) for name in wanted}
        if wild:
            return f"output {wild[0]} is not finite"
        found["sqnr_db"] = {
            name: each if math.isfinite(each) else None for name, each in noise.items()
        }
        if answers != self._reference:
            answers.unlink()
        return found


def provider_or_reason(name: str) -> Provider | str:
    """Return a provider that is installed, or what to install."""
    try:
        return provider_named(name)
    except ProviderError as error:
        return str(error)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--providers", default=",".join(PROVIDERS.names()))
    parser.add_argument("--subjects", default="highway,vad-tiny")
    parser.add_argument("--plugins", type=Path, action="append", default=[])
    parser.add_argument("--dialect", default="tensorrt")
    parser.add_argument("--frames", type=int, help="to calibrate on")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--warm-up", type=int, default=20)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--no-energy", action="store_false", dest="energy")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows: list[Found] = []
    for name in given.subjects.split(","):
        frames = given.frames or FRAMES[name]
        bench = Bench(subjects.make(name, given.out, frames), frames, given)
        bench.found(CPU, REFERENCE, ROWS[REFERENCE])
        for each in given.providers.split(","):
            provider = provider_or_reason(each)
            if isinstance(provider, str):
                rows.append(Found(name, each, "every file", reason=provider))
            else:
                rows += bench.rows(provider)
            write(given.out, rows)
    print((given.out / "table.md").read_text("utf-8"))


if __name__ == "__main__":
    main()
