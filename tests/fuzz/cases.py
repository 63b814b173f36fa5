"""Commands on broken inputs: what a user could type, and the files that it reads."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from tests.fuzz import frames, graphs, texts
from tests.fuzz.good import ADAPTER, MAP, OVERRIDES, RECIPE, STUDY


@dataclasses.dataclass(frozen=True)
class Case:
    """One command, run in a folder of its own beside the good files.

    Attributes:
        name: of the fault.
        line: the command; good files are ``../good/...``.
        files: that are broken, by name.
        more: words that may hold spaces.
    """

    name: str
    line: str
    files: Mapping[str, bytes] = dataclasses.field(default_factory=dict)
    more: tuple[str, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """The command and its words."""
        return (*self.line.split(), *self.more)


M, F = "../good/model.onnx", "../good/frames"
UNVERIFIED = f"compress {M} -o out.onnx --verify-frames 0"

OPENERS = {
    "inspect": "inspect bad.onnx",
    "inspect-mapped": "inspect bad.onnx --map ../good/map.toml --json",
    "plan": "plan bad.onnx -v",
    "lint": "lint bad.onnx",
    "unchecked": "compress bad.onnx -r exact -o out.onnx --verify-frames 0",
}
"""Commands that open a graph, and no session of onnxruntime with it."""

RUNNERS = {
    "calibrate": f"calibrate bad.onnx {F} -o out.json",
    "compare": f"compare {M} bad.onnx {F}",
    "profile": f"profile bad.onnx {F} -o out.json --samples 2",
    "evaluate": "evaluate bad.onnx -o out --routes 1",
}


def graph_cases(_: Path) -> Iterator[Case]:
    """Yield every broken graph and file, and drawn ones; the commands take turns."""
    turn = itertools.cycle(OPENERS.items())
    for name, content in itertools.chain(
        graphs.broken_graphs(),
        graphs.broken_files(),
        map(graphs.drawn_graph, range(80)),
    ):
        opener, line = next(turn)
        yield Case(f"{opener}-{name}", line, {"bad.onnx": content})


def frame_cases(_: Path) -> Iterator[Case]:
    """Yield broken frames and indexes of scenes."""
    turn = itertools.cycle(
        (
            f"calibrate {M} bad -o out.json",
            f"compare {M} {M} bad",
            f"profile {M} bad -o out.json --samples 2",
            f"compress {M} -r exact --frames bad -o out.onnx",
        )
    )
    good, index = frames.npz(**frames.GOOD), b'{"scenes": [0]}'
    for name, content in frames.broken_frames():
        files = {"bad/000000.npz": content, "bad/scenes.json": index}
        yield Case(f"frame-{name}", next(turn), files)
    drawn = texts.broken_json('{"scenes": [0, 1]}', 20)
    for name, content in itertools.chain(texts.neither(), drawn):
        files = {f"bad/{each:06d}.npz": good for each in range(2)}
        yield Case(f"scenes-{name}", next(turn), {**files, "bad/scenes.json": content})


JSON = {
    "plan": ("plan.json", "plan bad.json -v"),
    "ranges": (
        "ranges.json",
        f"compress {M} --scheme full --ranges bad.json --frames {F} -o out.onnx",
    ),
    "trace": (
        "trace.json",
        "evaluate blind --latency trace:bad.json --routes 0 -o out",
    ),
    "routes": (
        "routes.json",
        "evaluate blind --routes bad.json --render no-such -o out",
    ),
}
"""A good document and a command that reads it, by the format's name."""

TOML = {
    "map": (MAP, f"inspect {M} --map bad.toml"),
    "overrides": (OVERRIDES, f"plan {M} --overrides bad.toml"),
    "recipe": (RECIPE, f"{UNVERIFIED} -r bad.toml"),
    "study": (STUDY, "study bad.toml -o out"),
    "adapter": (ADAPTER, f"evaluate {M} --adapter bad.toml --routes 1 -o out"),
}


def json_cases(good: Path) -> Iterator[Case]:
    """Yield broken JSON files of every kind."""
    for turn, (kind, (name, line)) in enumerate(JSON.items()):
        drawn = texts.broken_json((good / name).read_text(), 8)
        none = itertools.islice(texts.neither(), turn % 3, None, 3)
        for which, content in itertools.chain(none, drawn):
            yield Case(f"{kind}-{which}", line, {"bad.json": content})


def toml_cases(_: Path) -> Iterator[Case]:
    """Yield broken TOML files of every kind."""
    for turn, (kind, (text, line)) in enumerate(TOML.items()):
        none = itertools.islice(texts.neither(), turn % 2, None, 2)
        beside = {"overrides.toml": OVERRIDES.encode()} if kind == "recipe" else {}
        for which, content in itertools.chain(none, texts.broken_toml(text, 10)):
            yield Case(f"{kind}-{which}", line, {**beside, "bad.toml": content})


def result_cases(good: Path) -> Iterator[Case]:
    """Yield folders of results with a broken manifest or route."""
    names = ("evaluation.json", "routes/r1.json")
    whole = {f"bad/{name}": (good / "results" / name).read_bytes() for name in names}
    for name, text in whole.items():
        drawn = texts.broken_json(text.decode(), 15)
        for which, content in itertools.chain(texts.neither(), drawn):
            yield Case(f"{name}-{which}", "score bad", {**whole, name: content})


def pipeline_cases(_: Path) -> Iterator[Case]:
    """Yield texts for ``--passes``."""
    for number, text in enumerate(texts.PIPELINES):
        yield Case(f"pipeline-{number}", f"{UNVERIFIED} --passes", more=(text,))


def cache_cases(_: Path) -> Iterator[Case]:
    """Yield broken caches of TensorRT."""
    for name, content in texts.neither():
        head = b"TRT-1-A\nx: " if len(name) % 2 else b""
        line = f"calibrate {M} --import bad.cache -o out.json"
        yield Case(f"cache-{name}", line, {"bad.cache": head + content})


def session_cases(_: Path) -> Iterator[Case]:
    """Yield names that are not UTF-8, which onnxruntime repeats in its messages."""
    content = graphs.seed_graph().SerializeToString()
    broken = content.replace(b"memory_out", b"memo\xb7y_out")
    for runner, line in RUNNERS.items():
        yield Case(f"{runner}-utf-8", line, {"bad.onnx": broken})


def output_cases(_: Path) -> Iterator[Case]:
    """Yield every command that writes, its output no name of a file."""
    names = ("", ".", "..", "/", "../good", "no/such/x", "a" * 300)
    lines = (
        *(f"compress {M} -r exact", f"calibrate {M} {F}", f"plan {M}"),
        *(f"profile {M} {F}", f"search {M} {F} --max-mb 1", f"sensitivity {M} {F}"),
        *(f"frames {M}", f"evaluate {M} --routes 1", "study ../good/map.toml"),
    )
    for name, line in itertools.product(names, lines):
        yield Case(f"output-{line.split()[0]}-{name[:20]}", f"{line} -o", more=(name,))


GROUPS: Mapping[str, Callable[[Path], Iterator[Case]]] = {
    "graphs": graph_cases,
    "frames": frame_cases,
    "json": json_cases,
    "toml": toml_cases,
    "results": result_cases,
    "pipelines": pipeline_cases,
    "caches": cache_cases,
    "outputs": output_cases,
    "sessions": session_cases,
}
"""Cases, given the folder of good files."""
