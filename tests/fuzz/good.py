"""Good files of every kind that a command reads."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import load_routes, save_routes
from tests.fuzz import frames, graphs
from tests.metrics.drives import cruise, drive
from tests.support.frames import record
from tests.support.nets import MAP_TEXT

Command = Callable[..., int]

MAP = f"""
strip = ["model"]
{MAP_TEXT}optional = ["head.*"]
"""
OVERRIDES = """
[[override]]
nodes = "/head/L*"
dtype = "float"
reason = "costs 3 dB"
"""
RECIPE = """
[[pass]]
name = "fold-constants"
through_compute = true
[[pass]]
name = "quantize-int8"
scheme = "full"
rules = "paper"
ranges = "../good/ranges.json"
overrides = "overrides.toml"
"""
ADAPTER = """
axes = "forward-left"
[inputs]
img = "image"
[recurrent]
memory = "memory_out"
[plan]
output = "y"
deltas = true
default_mode = 1
[image]
mean = [1.0, 2.0, 3.0]
std = [1.0, 2.0, 3.0]
to_rgb = true
"""
STUDY = """
title = "Study"
baseline = "a"
routes = 2
seed = 1
frames = "../good/frames"
held_out = "../good/frames"
[latency]
samples = 3
threads = 1
baseline_median_s = 0.5
[[variant]]
name = "a"
policy = "../good/model.onnx"
passes = "fold-constants"
map = "../good/map.toml"
adapter = "../good/adapter.toml"
trace = "../good/trace.json"
[[condition]]
name = "slow"
latency = "fps:2"
"""


def write_good(folder: Path, command: Command) -> None:
    """Make one good file of every kind, by the commands that write them."""
    folder.mkdir()
    model = folder / "model.onnx"
    model.write_bytes(graphs.seed_graph().SerializeToString())
    record(folder / "frames", [frames.GOOD] * 2)
    for name, text in {"map": MAP, "overrides": OVERRIDES, "adapter": ADAPTER}.items():
        (folder / f"{name}.toml").write_text(text)
    recorded = (model, folder / "frames", "-o")
    assert command("calibrate", *recorded, folder / "ranges.json") == 0
    assert command("plan", model, "-o", folder / "plan.json") == 0
    assert command("profile", *recorded, folder / "trace.json") == 0
    int8 = ("--frames", folder / "frames", "--scheme", "full", "--rules", "paper")
    assert command("compress", model, "-o", folder / "small.onnx", *int8) == 0
    save_routes(load_routes()[:2], folder / "routes.json")
    write_results(folder / "results", drive(driven=cruise()))


def write_results(folder: Path, episode: Episode) -> None:
    """Write a folder of results of one route."""
    (folder / "routes").mkdir(parents=True)
    made_by = {"routes": [episode.route], "set_size": 1, "version": "1"}
    (folder / "evaluation.json").write_text(json.dumps(made_by))
    digest = hashlib.sha256(json.dumps(made_by, sort_keys=True).encode()).hexdigest()
    record = {"fingerprint": digest, "episode": episode.to_json()}
    (folder / "routes" / f"{episode.route}.json").write_text(json.dumps(record))
