"""Commands on broken inputs: what a user could type, and the files that it reads."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path

from tests.fuzz import frames, graphs, texts
from tests.fuzz.good import ADAPTER, MAP, OVERRIDES, RECIPE, STUDY


@dataclasses.dataclass(frozen=True)
class Case:
    """One command, run in a folder of its own beside the good files.

    Attributes:
        name: of the fault.
        words: of the command; good files are ``../good/...``.
        files: that are broken, by name.
    """

    name: str
    words: tuple[str, ...]
    files: Mapping[str, bytes]


MODEL, FRAMES = "../good/model.onnx", "../good/frames"

OPENERS: Mapping[str, tuple[str, ...]] = {
    "inspect": ("inspect", "bad.onnx"),
    "inspect-mapped": (
        *("inspect", "bad.onnx", "--map", "../good/map.toml", "--json"),
    ),
    "plan": ("plan", "bad.onnx", "-v"),
    "lint": ("lint", "bad.onnx"),
    "unchecked": (
        *("compress", "bad.onnx", "-r", "exact", "-o", "out.onnx"),
        *("--verify-frames", "0"),
    ),
}
"""Commands that open a graph, and no session of onnxruntime with it."""

RUNNERS: Mapping[str, tuple[str, ...]] = {
    "calibrate": ("calibrate", "bad.onnx", FRAMES, "-o", "out.json"),
    "compare": ("compare", MODEL, "bad.onnx", FRAMES),
    "profile": ("profile", "bad.onnx", FRAMES, "-o", "out.json", "--samples", "2"),
    "evaluate": ("evaluate", "bad.onnx", "-o", "out", "--routes", "1"),
}


def graph_cases(drawn: int) -> Iterator[Case]:
    """Yield every broken graph and file, and drawn ones; the commands take turns."""
    turn = itertools.cycle(OPENERS)
    found = itertools.chain(
        graphs.broken_graphs(),
        graphs.broken_files(),
        map(graphs.drawn_graph, range(drawn)),
    )
    for name, content in found:
        opener = next(turn)
        yield Case(f"{opener}-{name}", OPENERS[opener], {"bad.onnx": content})


def frame_cases() -> Iterator[Case]:
    """Yield broken frames and indexes of scenes."""
    turn = itertools.cycle(
        [
            ("calibrate", MODEL, "bad", "-o", "out.json"),
            ("compare", MODEL, MODEL, "bad"),
            ("profile", MODEL, "bad", "-o", "out.json", "--samples", "2"),
            ("compress", MODEL, "-r", "exact", "--frames", "bad", "-o", "out.onnx"),
        ]
    )
    good, index = frames.npz(**frames.GOOD), b'{"scenes": [0]}'
    for name, content in frames.broken_frames():
        files = {"bad/000000.npz": content, "bad/scenes.json": index}
        yield Case(f"frame-{name}", next(turn), files)
    drawn = texts.broken_json('{"scenes": [0, 1]}', 20)
    for name, content in itertools.chain(texts.neither(), drawn):
        files = {f"bad/{each:06d}.npz": good for each in range(2)}
        files["bad/scenes.json"] = content
        yield Case(f"scenes-{name}", next(turn), files)


def _json_words(good: Path) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return a good document and a command that reads it, by the format's name."""
    given = ("--frames", FRAMES, "-o", "out.onnx")
    return {
        "plan": ("plan.json", ("plan", MODEL, "--against", "bad.json")),
        "plan-alone": ("plan.json", ("plan", "bad.json", "-v")),
        "ranges": (
            "ranges.json",
            ("compress", MODEL, "--scheme", "full", "--ranges", "bad.json", *given),
        ),
        "trace": (
            "trace.json",
            ("evaluate", "blind", "--latency", "trace:bad.json", "--routes", "0",
             "-o", "out"),
        ),
        "routes": (
            "routes.json",
            ("routes", "--examine", "bad.json", "--routes", "no-such-route"),
        ),
    }  # fmt: skip


def json_cases(good: Path, count: int) -> Iterator[Case]:
    """Yield broken JSON files of every kind."""
    for turn, (kind, (name, words)) in enumerate(_json_words(good).items()):
        drawn = texts.broken_json((good / name).read_text(), count)
        none = itertools.islice(texts.neither(), turn % 3, None, 3)
        for which, content in itertools.chain(none, drawn):
            yield Case(f"{kind}-{which}", words, {"bad.json": content})


def toml_cases(count: int) -> Iterator[Case]:
    """Yield broken TOML files of every kind."""
    compress = ("compress", MODEL, "-o", "out.onnx", "--verify-frames", "0")
    kinds = {
        "map": (MAP, ("inspect", MODEL, "--map", "bad.toml")),
        "overrides": (OVERRIDES, ("plan", MODEL, "--overrides", "bad.toml")),
        "recipe": (RECIPE, (*compress, "-r", "bad.toml")),
        "study": (STUDY, ("study", "bad.toml", "-o", "out")),
        "adapter": (
            ADAPTER,
            ("evaluate", MODEL, "--adapter", "bad.toml", "--routes", "1", "-o", "out"),
        ),
    }
    for turn, (kind, (text, words)) in enumerate(kinds.items()):
        drawn = texts.broken_toml(text, count)
        none = itertools.islice(texts.neither(), turn % 2, None, 2)
        beside = {"overrides.toml": OVERRIDES.encode()} if kind == "recipe" else {}
        for which, content in itertools.chain(none, drawn):
            yield Case(f"{kind}-{which}", words, {**beside, "bad.toml": content})


def result_cases(good: Path, count: int) -> Iterator[Case]:
    """Yield folders of results with a broken manifest or route."""
    files = {"evaluation.json": "evaluation.json", "routes/r1.json": "routes/r1.json"}
    whole = {f"bad/{name}": (good / "results" / name).read_bytes() for name in files}
    for name in files:
        text = whole[f"bad/{name}"].decode()
        drawn = texts.broken_json(text, count)
        for which, content in itertools.chain(texts.neither(), drawn):
            changed = {**whole, f"bad/{name}": content}
            yield Case(f"results-{name}-{which}", ("score", "bad"), changed)


def pipeline_cases() -> Iterator[Case]:
    """Yield texts for ``--passes``."""
    compress = ("compress", MODEL, "-o", "out.onnx", "--verify-frames", "0")
    for number, text in enumerate(texts.PIPELINES):
        yield Case(f"pipeline-{number}", (*compress, "--passes", text), {})


def cache_cases() -> Iterator[Case]:
    """Yield broken caches of TensorRT."""
    cache = ("calibrate", MODEL, "--import", "bad.cache", "-o", "out.json")
    for name, content in texts.neither():
        line = b"TRT-1-A\nx: " if len(name) % 2 else b""
        yield Case(f"cache-{name}", cache, {"bad.cache": line + content})


def session_cases() -> Iterator[Case]:
    """Yield names that are not UTF-8, which onnxruntime repeats in its messages."""
    content = graphs.seed_graph().SerializeToString()
    broken = content.replace(b"memory_out", b"memo\xb7y_out")
    for runner, words in RUNNERS.items():
        yield Case(f"{runner}-utf-8", words, {"bad.onnx": broken})


def output_cases() -> Iterator[Case]:
    """Yield every command that writes, its output no name of a file."""
    names = ("", ".", "..", "/", "../good", "no/such/x", "a" * 300)
    commands = (
        ("compress", MODEL, "-r", "exact"),
        ("calibrate", MODEL, FRAMES),
        ("plan", MODEL),
        ("profile", MODEL, FRAMES),
        ("search", MODEL, FRAMES, "--max-mb", "1"),
        ("sensitivity", MODEL, FRAMES),
        ("frames", MODEL),
        ("evaluate", MODEL, "--routes", "1"),
        ("study", "../good/map.toml"),
    )
    for name, words in itertools.product(names, commands):
        yield Case(f"output-{words[0]}-{name[:20]}", (*words, "-o", name), {})
