"""Many graphs, each judged by some pipelines in turn; a chunk is a line of a file.

A run that is killed goes on where it was: chunks that stand in the file, judged by the
same code, are not judged again.
"""

import collections
import concurrent.futures
import dataclasses
import functools
import hashlib
import json
import multiprocessing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import me2e_compress
from tests.fuzz.exact import int8
from tests.fuzz.exact.drawing import drawing
from tests.fuzz.exact.findings import Judged, judged, report, signature
from tests.fuzz.exact.judging import BAD
from tests.fuzz.exact.pipelines import SLOW, for_graph
from tests.fuzz.exact.rotation import LONG, some_for

CHUNK = 25
"""Graphs of one line; a kill loses at most as many for each process."""

INT8_EVERY = 10
"""One graph of so many is quantized too."""

Counts = dict[str, dict[str, int]]


@dataclasses.dataclass
class Tally:
    """What came of some graphs.

    Attributes:
        first: the first seed.
        code: a digest of the toolkit and of this tester.
        graphs: how many.
        kinds: by the pipeline's label, how many verdicts of each kind.
        changed: by pass, on how many graphs it changed something.
        motifs: by name, in how many graphs.
        refusals: by message, how many.
        findings: seed, label, kind, detail and the shrunk graph of what is bad.
    """

    first: int
    code: str
    graphs: int = 0
    kinds: Counts = dataclasses.field(default_factory=dict)
    changed: dict[str, int] = dataclasses.field(default_factory=dict)
    motifs: dict[str, int] = dataclasses.field(default_factory=dict)
    refusals: dict[str, int] = dataclasses.field(default_factory=dict)
    findings: list[dict[str, Any]] = dataclasses.field(default_factory=list)

    def add(self, seed: int, found: Judged) -> bool:
        """Count a verdict; say whether it is bad."""
        verdict = found.verdict
        row = self.kinds.setdefault(found.label, {})
        row[verdict.kind] = row.get(verdict.kind, 0) + 1
        if verdict.kind == "refused":
            said = verdict.detail[:120]
            self.refusals[said] = self.refusals.get(said, 0) + 1
        return verdict.is_bad

    def merge(self, other: "Tally") -> None:
        """Add another tally to this one."""
        self.graphs += other.graphs
        for label, row in other.kinds.items():
            mine = collections.Counter(self.kinds.get(label, {}))
            mine.update(row)
            self.kinds[label] = dict(mine)
        for name in ("changed", "motifs", "refusals"):
            counts = collections.Counter(getattr(self, name))
            counts.update(getattr(other, name))
            setattr(self, name, dict(counts))
        self.findings += other.findings

    @property
    def bad(self) -> int:
        """How many verdicts are bad."""
        rows = self.kinds.values()
        return sum(count for row in rows for kind, count in row.items() if kind in BAD)


def judge_chunk(first: int, count: int) -> Tally:
    """Judge some graphs; shrink one finding of each cause."""
    tally, known = Tally(first, digest_of_code()), set[tuple[str, str, str]]()
    for seed in range(first, first + count):
        drawn = drawing(seed)
        tally.graphs += 1
        for motif in set(drawn.motifs):
            tally.motifs[motif] = tally.motifs.get(motif, 0) + 1
        active = set[str]()
        for found in _verdicts(seed):
            active |= {name for name, n in found.verdict.changes if n}
            if not tally.add(seed, found):
                continue
            cause = signature(found.verdict)
            shrinkable = cause not in known and not found.label.startswith("int8")
            known.add(cause)
            tally.findings.append(_finding(seed, found, shrinkable))
        for name in active:
            tally.changed[name] = tally.changed.get(name, 0) + 1
    return tally


def _verdicts(seed: int) -> Iterator[Judged]:
    drawn = drawing(seed)
    slow = [each for each in for_graph(drawn.model, seed) if each.label in SLOW]
    chosen = some_for(drawn.model, seed, LONG)
    yield from judged(seed, drawn, (*chosen, *slow))
    if seed % INT8_EVERY == 0:
        yield from int8.judged(seed, drawn.model)


def _finding(seed: int, found: Judged, shrinkable: bool) -> dict[str, Any]:
    verdict = found.verdict
    return {
        "seed": seed,
        "label": found.label,
        "kind": verdict.kind,
        "pipeline": verdict.pipeline,
        "detail": verdict.detail,
        "text": report(seed, verdict) if shrinkable else "",
    }


@functools.cache
def digest_of_code() -> str:
    """Name the code that judges: after a change, nothing of before counts."""
    seal = hashlib.blake2b(digest_size=8)
    for folder in (Path(me2e_compress.__file__).parent, Path(__file__).parent):
        for file in sorted(folder.rglob("*.py")):
            seal.update(file.read_bytes())
    return seal.hexdigest()


def read(path: Path, code: str) -> Iterator[Tally]:
    """Read the chunks that some code has judged; a line cut short is none."""
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            tally = Tally(**json.loads(line))
        except json.JSONDecodeError:
            continue
        if tally.code == code:
            yield tally


def run(
    path: Path,
    first: int,
    graphs: int,
    jobs: int,
    progress: Callable[[Tally, Tally], None],
) -> Tally:
    """Judge a range of seeds on some processes and append every chunk to a file.

    Args:
        path: of the file.
        first: the first seed.
        graphs: how many.
        jobs: how many processes.
        progress: called with each chunk that is done, and all there is so far.
    """
    total = Tally(first, digest_of_code())
    end = first + graphs
    chunks = {start: min(CHUNK, end - start) for start in range(first, end, CHUNK)}
    for tally in read(path, total.code):
        if chunks.get(tally.first) == tally.graphs:
            total.merge(tally)
            del chunks[tally.first]
    path.parent.mkdir(parents=True, exist_ok=True)
    with concurrent.futures.ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn")
    ) as pool:
        waiting = [pool.submit(judge_chunk, *each) for each in chunks.items()]
        for each in concurrent.futures.as_completed(waiting):
            tally = each.result()
            with path.open("a") as file:
                file.write(json.dumps(dataclasses.asdict(tally)) + "\n")
            total.merge(tally)
            progress(tally, total)
    return total
