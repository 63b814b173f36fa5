"""``calibrate``: ranges are saved, and held against another tool's."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from tests.docs.pages import ROOT
from tests.support.command import Cli
from tests.support.frames import record, tensorrt_cache
from tests.support.nets import MAP_TEXT, conv_attention, image

MAP = "--map map.toml"
RANGES = f"calibrate dense.onnx scenes {MAP}"


@pytest.fixture
def folder(dense: Path) -> Path:
    """The dense model, with three scenes of two frames."""
    draws = np.random.default_rng(1)
    frames = [
        {"camera": draws.normal(size=(4, 16)).astype(np.float32)} for _ in range(6)
    ]
    record(dense / "scenes", frames, (0, 2, 4))
    return dense


def write_cache(folder: Path) -> str:
    """Write the cache of a TensorRT that measured the ranges in r.json; return it."""
    ranges = json.loads((folder / "r.json").read_text())["tensors"]
    (folder / "c").write_text(tensorrt_cache(ranges))
    return (folder / "c").read_text()


def test_a_cache_of_tensorrt_10_becomes_an_explicit_graph(
    cli: Cli, tmp_path: Path
) -> None:
    write_net(tmp_path)
    cli.done(f"calibrate m.onnx frames {MAP} -o r.json")
    head, *scales = write_cache(tmp_path).splitlines()
    kept = [line for line in scales if not line.startswith("p: ")]
    (tmp_path / "c").write_text("\n".join([head, *kept]))

    said = cli.done(f"calibrate m.onnx --import c {MAP} -o back.json").words
    assert "1 tensor not in c: p. What reads them stays float" in said
    assert "--overrides back.overrides.toml" in said

    how = f"compress m.onnx --scheme full --rules paper --target tensorrt {MAP}"
    how += " --ranges back.json"
    refused = cli.refused(f"{how} -o int8.onnx")
    assert "back.json: of 5 tensors lacks p;" in refused
    assert "give the overrides that stand beside it" in refused
    cli.done(f"{how} --overrides back.overrides.toml -o int8.onnx")

    made = graph.load(tmp_path / "int8.onnx").graph
    nodes = [each for each in made if each.op_type == "QuantizeLinear"]
    steps = {float(each.inputs[1].const_value.numpy()) for each in nodes}  # type: ignore[union-attr]
    told = {struct.unpack("!f", bytes.fromhex(each[-8:]))[0] for each in kept}
    assert steps
    assert steps <= told
    assert "p" not in [each.inputs[0].name for each in nodes if each.inputs[0]]


def test_the_commands_of_the_page_lead_from_a_cache_to_int8(
    cli: Cli, tmp_path: Path
) -> None:
    write_net(tmp_path)
    cli.done(f"calibrate m.onnx frames {MAP} -o r.json")
    write_cache(tmp_path)
    (tmp_path / "c").rename(tmp_path / "trt10.cache")
    (tmp_path / "m.onnx").rename(tmp_path / "vad.onnx")
    page = (ROOT / "docs" / "quantization.md").read_text(encoding="utf-8")
    lines = (
        page.partition("### From a TensorRT 10 cache")[2].split("```")[1].split("\n")
    )
    more = {"calibrate": MAP, "compress": f"{MAP} --rules paper"}

    for line in filter(None, lines):
        words = line.removeprefix("me2e-compress ")
        cli.done(f"{words} {more.get(words.split()[0], '')}")

    assert "QuantizeLinear" in [n.op_type for n in graph.load("vad.int8.onnx").graph]


@pytest.mark.parametrize(
    ("factor", "kind"), [(5e7, "rounds to zero"), (1e-3, "clipped")]
)
def test_scales_of_a_cache_are_held_against_two_frames(
    cli: Cli, folder: Path, factor: float, kind: str
) -> None:
    cli.done(f"{RANGES} -o r.json")
    cache = write_cache(folder).splitlines()
    name, _, text = cache[1].rpartition(": ")
    (scale,) = struct.unpack("!f", bytes.fromhex(text))
    cache[1] = f"{name}: {struct.pack('!f', scale * factor).hex()}"
    (folder / "c").write_text("\n".join(cache))

    unseen = cli.document(f"calibrate dense.onnx --import c {MAP} -o back.json")
    seen = cli.document(f"calibrate dense.onnx scenes --import c {MAP} -o back.json")

    assert unseen["findings"] == []
    (finding,) = seen["findings"]
    assert (finding["kind"], finding["names"]) == (kind, [name])
    assert seen["status"] == "warning"


def write_net(folder: Path) -> None:
    """Write a graph of several tensors, its map and two frames."""
    graph.save(conv_attention(), folder / "m.onnx")
    record(folder / "frames", [image(seed) for seed in range(2)], (0,))
    (folder / "map.toml").write_text(MAP_TEXT)
