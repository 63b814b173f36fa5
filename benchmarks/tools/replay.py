"""Do two commits write the same files? Names each that differs, and the pass.

    python -m benchmarks.tools.replay [--base COMMIT] [--subjects driver,stacks,drawn]
        [--folder FOLDER]

Every recipe of the driver that ships, of small VAD, UniAD and TCP
(`benchmarks.subjects.small_stacks`) and of twenty drawn graphs (`tests.fuzz.exact`)
is made by COMMIT (the last tag; where there is none, the parent) and by this checkout,
both at once, each in one process. Graphs and frames are those of this checkout. What a
recipe writes is held against the other's byte by byte, the report behind `masks`. Where
a graph differs, both run growing parts of the recipe until the pass stands that parts
them. Exit code 1 if a file differs. FOLDER, kept if it is named, gets it all.
"""

import argparse
import hashlib
import itertools
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from benchmarks.tools.masks import masked
from me2e_compress.shipped.drivers import SHIPPED
from tests.fuzz.exact.drawing import draw
from tests.fuzz.exact.running import RefusedError, Runner, drawn_inputs, open_sizes
from tests.support.frames import record

ROOT = Path(__file__).parents[2]
SUBJECTS = ("driver", "stacks", "drawn")
RECIPES = {
    "driver": ("exact", "fused", "feature-ext", "prediction", "full", "full-fused"),
    "stacks": ("exact", "fused", "full", "full-fused"),
    "drawn": ("exact", "fused", "full", "full-fused"),
}
WITHOUT_TARGET = ("exact", "fused")
TARGETS = ("onnxruntime", "tensorrt")
DRAWN = 20

CHILD = """
import contextlib, io, json, sys
from me2e_compress.cli import main
for line in sys.stdin:
    sys.argv = ["me2e-compress", *json.loads(line)]
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        code = main()
    print(json.dumps([code, text.getvalue()]), flush=True)
"""
"""Runs command lines one after the other: an import a graph would cost minutes."""

Words = list[str]


@dataclass(frozen=True)
class Subject:
    """One graph with its frames and the recipes that are made of it."""

    name: str
    model: Path
    frames: Path
    recipes: tuple[str, ...]

    def jobs(self) -> Iterator["Job"]:
        """Yield a recipe and a target after the other; exact recipes have no target."""
        for recipe in self.recipes:
            for target in TARGETS[: 1 if recipe in WITHOUT_TARGET else None]:
                yield Job(self, ("-r", recipe), target)


@dataclass(frozen=True)
class Job:
    """One command line: what is made of a subject, and for which target."""

    subject: Subject
    passes: tuple[str, str]
    target: str

    @property
    def file(self) -> str:
        """The name of the file that it writes."""
        text = self.passes[1]
        if self.passes[0] != "-r":
            text = hashlib.sha256(text.encode()).hexdigest()[:16]
        return f"{self.subject.name}.{text}.{self.target}.onnx"

    def words(self) -> Words:
        """Return the command line."""
        subject, lossless = self.subject, self.passes[1] in WITHOUT_TARGET
        words = ["compress", str(subject.model), *self.passes, "-o", self.file]
        words += [] if lossless else ["--target", self.target]
        return [*words, "--frames", str(subject.frames), "--force", "--quiet"]


class Tree:
    """A checkout that runs commands in a folder of its own.

    ``prepare`` starts jobs, ``wait`` ends them; files stay for later questions.
    """

    def __init__(self, package: Path, folder: Path) -> None:
        self.package, self.folder = package, folder
        folder.mkdir(parents=True)
        self.texts: dict[str, str] = {}

    def start(self, jobs: Sequence[Job]) -> "subprocess.Popen[str]":
        """Start one process for all jobs."""
        path = {"PYTHONPATH": str(self.package.parent)}
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD],
            cwd=self.folder,
            env={**os.environ, **path, "XDG_CACHE_HOME": str(self.folder / "cache")},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert child.stdin is not None
        child.stdin.writelines(f"{json.dumps(job.words())}\n" for job in jobs)
        child.stdin.close()
        return child

    def finish(self, child: "subprocess.Popen[str]", jobs: Sequence[Job]) -> None:
        """Read what the jobs answered."""
        assert child.stdout is not None
        lines = child.stdout.read().splitlines()
        if child.wait() or len(lines) != len(jobs):
            sys.exit(f"{self.package}: ended after {len(lines)} of {len(jobs)} jobs")
        for job, line in zip(jobs, lines, strict=True):
            code, text = json.loads(line)
            failed = not (self.folder / job.file).is_file()
            self.texts[job.file] = f"exit {code}: {text}" if failed else ""

    def digest(self, job: Job) -> str:
        """Return the SHA-256 of the graph that a job wrote, or why it wrote none."""
        path = self.folder / job.file
        if not path.is_file():
            return self.texts[job.file]
        return hashlib.sha256(path.read_bytes()).hexdigest()

    def report(self, job: Job) -> bytes:
        """Return the report of a job without what no two runs have alike."""
        name = self.report_name(job)
        if not (self.folder / name).is_file():
            return b""
        return masked(self.folder, name, self.package)

    def steps(self, job: Job) -> list[str]:
        """Return the passes of a job as texts."""
        path = self.folder / self.report_name(job)
        if not path.is_file():
            return []
        return [step["text"] for step in json.loads(path.read_text("utf-8"))["steps"]]

    @staticmethod
    def report_name(job: Job) -> str:
        return f"{job.file.removesuffix('.onnx')}.report.json"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--base", help="a commit; the last tag, or the parent")
    parser.add_argument("--subjects", default=",".join(SUBJECTS))
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    base = given.base or last_tag() or "HEAD^"
    with tempfile.TemporaryDirectory(prefix="replay-") as scratch:
        folder = (given.folder or Path(scratch, "replay")).resolve()
        before = Tree(checked_out(base, folder / "checkout"), folder / "before")
        after = Tree(ROOT / "me2e_compress", folder / "after")
        subjects = list(made(given.subjects.split(","), folder / "subjects"))
        jobs = [job for subject in subjects for job in subject.jobs()]
        run(jobs, before, after)
        different = 0
        for job in jobs:
            for line in differences(job, before, after):
                different += 1
                print(line, flush=True)
        # a run in which nothing is written would show no difference either
        empty = sum(not (after.folder / job.file).is_file() for job in jobs)
        print(
            f"{different} of {len(jobs)} recipes differ from {base};"
            f" {empty} write no file"
        )
    return int(different > 0 or empty == len(jobs))


def last_tag() -> str:
    """Return the last tag before this commit, or nothing."""
    words = ["git", "describe", "--tags", "--abbrev=0"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def checked_out(commit: str, folder: Path) -> Path:
    """Write the package as it was at a commit; return its folder."""
    folder.mkdir(parents=True)
    words = ["git", "archive", commit, "me2e_compress"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, check=False)
    if done.returncode:
        sys.exit(f"{commit}: {done.stderr.decode().strip()}")
    with tarfile.open(fileobj=BytesIO(done.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return folder / "me2e_compress"


def made(names: Iterable[str], folder: Path) -> Iterator[Subject]:
    """Make the graphs and frames of the named groups of subjects."""
    for name in names:
        place = folder / name
        place.mkdir(parents=True)
        MAKERS[name](place)
        for model in sorted(place.glob("*.onnx")):
            yield Subject(model.stem, model, model.with_suffix(""), RECIPES[name])


def make_driver(folder: Path) -> None:
    """Export the driver that ships, and record four frames in scenes of two."""
    (stack,) = SHIPPED
    for words in (
        ["export", stack, "-o", f"{stack}.onnx"],
        ["frames", stack, "-n", "4", "--scene-length", "2", "-o", stack],
    ):
        command = [sys.executable, "-m", "me2e_compress", *words]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)


def make_stacks(folder: Path) -> None:
    """Export small VAD, UniAD and TCP, with frames."""
    command = [sys.executable, "-m", "benchmarks.subjects.small_stacks", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True)


def make_drawn(folder: Path) -> None:
    """Draw graphs that the runtime takes, with two frames each."""
    count = 0
    for seed in itertools.count():
        if count == DRAWN:
            return
        model = draw(seed)
        try:
            runner = Runner(model)
        except RefusedError:
            continue
        (size, *_) = open_sizes(seed, model)
        frames = [drawn_inputs(runner, each, size) for each in (seed, seed + 1)]
        name = f"drawn-{seed:02}"
        (folder / f"{name}.onnx").write_bytes(model.SerializeToString())
        record(folder / name, frames, (0, 1))
        count += 1


MAKERS = {"driver": make_driver, "stacks": make_stacks, "drawn": make_drawn}


def run(jobs: Sequence[Job], *trees: Tree) -> None:
    """Let trees do the same jobs, side by side."""
    children = [tree.start(jobs) for tree in trees]
    for tree, child in zip(trees, children, strict=True):
        tree.finish(child, jobs)


def differences(job: Job, before: Tree, after: Tree) -> Iterator[str]:
    """Yield what differs in the files of a job: its graph, or else its report."""
    one, other = before.digest(job), after.digest(job)
    if one != other:
        yield f"{job.file}: {guilty_pass(job, before, after)}"
    elif before.report(job) != after.report(job):
        yield f"{before.report_name(job)}: the graph is the same"


def guilty_pass(job: Job, before: Tree, after: Tree) -> str:
    """Find the first pass behind which the two graphs differ."""
    steps = before.steps(job)
    if not steps or steps != after.steps(job):
        texts = before.texts[job.file], after.texts[job.file]
        return next(filter(None, texts), "").strip() or "another list of passes"
    # the graph after `low` passes is the same, after `high` it differs
    low, high = 0, len(steps)
    while high - low > 1:
        middle = (low + high) // 2
        part = Job(job.subject, ("--passes", ",".join(steps[:middle])), job.target)
        run([part], before, after)
        if before.digest(part) == after.digest(part):
            low = middle
        else:
            high = middle
    return steps[high - 1]


if __name__ == "__main__":
    sys.exit(main())
