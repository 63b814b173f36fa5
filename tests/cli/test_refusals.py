"""What users get wrong: one line that names the culprit, exit 1, nothing changed."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.graph import rewrite
from me2e_compress.simulator.routes import ROAD_VERSION, VERSION
from tests.support.command import Cli, write_frames
from tests.support.nets import parsed, save_text, stored

F = "dense.onnx frames --map map.toml"
EXACT = "in.onnx --map map.toml -o out.onnx --passes fold-constants"
SPLIT = "in.onnx --map map.toml -o out.onnx --passes"
BARE = "dense.onnx --map map.toml -o out.onnx"
INT8 = f"{BARE} --scheme full --frames frames"
GONE = r"old\.onnx: opset 6: onnxruntime has no Add of before"
KEPT = "is of 11: Hardmax 'pick' stays as it is: .*; -r exact writes a graph without"
TIMED = "profile dense.onnx frames -o out.json --samples 2"

COMPRESS = {
    EXACT.replace("in.", "junk."): r"junk\.onnx: not an ONNX",
    EXACT.replace("in.", "cut."): r"cut\.onnx",
    EXACT.replace("in.", "none."): r"none\.onnx: no such file",
    EXACT.replace("in.", "apart."): r"apart\.onnx\.data is missing",
    EXACT.replace("map.", "none."): r"none\.toml: no such file",
    EXACT.replace("map.", "radar."): "'radar_net' of module radar matches no",
    f"{EXACT} --frames wrong-name": r"000000\.npz.*camera",
    f"{EXACT} --frames wrong-shape": r"000000\.npz.*5",
    f"{EXACT} --frames wrong-dtype": r"000000\.npz.*float64",
    f"{EXACT} --frames nan": r"000000\.npz.*(?i:nan)",
    f"{EXACT} --frames inf": r"000000\.npz.*(?i:inf)",
    f"{EXACT} --frames cut": r"000000\.npz: not a readable \.npz \(",
    f"{EXACT} --frames empty": r"empty: holds no \.npz frames",
    f"{SPLIT} fold": "no pass 'fold'",
    f"{SPLIT} fold-constants{{speed=9}}": "fold-constants has no option 'speed'",
    f"{SPLIT} ablate-modules{{drop=[occ": r"a comma or \] is expected",
    f"{SPLIT} ablate-modules{{drop=7}}": "ablate-modules: drop",
    f"{SPLIT} ablate-modules{{drop=[radar]}}": "radar: no such module",
    f"{SPLIT} ablate-modules{{drop=[planner]}}": "planner cannot be dropped: it makes",
    f"{SPLIT.replace('in.', 'open.')} ablate-modules{{drop=[occ]}}": "zeros or a mean",
    "in.onnx -o out.onnx": "say what to do",
    "in.onnx -o out.onnx -r nothing": "no recipe nothing",
    "in.onnx -o out.onnx -r latin.toml": r"latin\.toml is not TOML",
    f"{BARE} -r exact --target tensorrt": "--target is for int8, and the",
    f"{BARE} --scheme full": r"--frames\) or saved ranges.*never made up",
    f"{BARE} --scheme full --frames wrong-name": "camera is missing",
    f"{BARE} --scheme full --frames wrong-shape": r"\[1, ?5\]|\(1, ?5\)",
    f"{BARE} --scheme int4 --frames frames": "no scheme int4; there are feature-ext",
    f"{BARE} -r full --scheme full --frames frames": "twice.*leave out --scheme",
    f"{BARE} --passes quantize-int8 --scheme full": "twice.*leave out --scheme",
    f"{BARE} --passes quantize-int8,quantize-int8": "twice.*leave out one of them",
    f"{BARE} --scheme full --ranges none.json": r"none\.json",
    f"{BARE} --scheme full --ranges latin.toml": r"latin\.toml: not ranges",
    f"{BARE} --scheme full --ranges other-graph.json": r"other-graph\.json: stale: of",
    f"{BARE} --scheme full --ranges no-frames.json": r"no-frames\.json: .*of 0 frames",
    f"{INT8} --ranges other-frames.json": "stale: of frames",
    f"{BARE} --scheme full --ranges nan.json": r"nan\.json: not ranges: a has nan to 1",
    f"{BARE} --scheme full --ranges inf.json": r"inf\.json: .*: a has -1 to inf; ",
    f"{BARE} --scheme full --ranges large.json": r"large\.json: .*: a has -1e\+39 to 1",
    f"{BARE} --scheme full --ranges turned.json": r"turned\.json: .*: a has 2 to 1; ",
    "old.onnx -o out.onnx -r exact": GONE,
    "pick.onnx -o out.onnx -r full --rules paper --frames frames": KEPT,
    "lstm.onnx -o out.onnx -r full --frames frames": (
        "made nothing int8; 0 layers .*; nothing is written; -r exact writes"
    ),
    f"{INT8} --rules int4": "no rule set 'int4'; there are safe",
    f"{INT8} --target npu": "no target 'npu'; there are tensorrt",
    f"{INT8} --method int4": "no calibration method 'int4'; ",
    f"{INT8} --map latin.toml": r"latin\.toml: not TOML",
    f"{INT8} --overrides latin.toml": r"latin\.toml: not TOML",
    f"{INT8} --overrides none.toml": r"none\.toml: no such file",
    f"{INT8} --overrides int4.toml": "dtype int4: only int8 and float are supported",
    f"{INT8} --overrides node.toml": r"/radar/\*'? matches none of 2 nodes",
    f"{INT8} --overrides module.toml": "radar'? matches none of 2 nodes",
    f"{INT8} --overrides reads.toml": "radar'? matches none of 2 nodes",
}
CALIBRATE = {
    "": "ranges are never made up",
    "frames --import x": "x: no such calibration cache",
    "frames --import map.toml": "map.toml: line 1 is not a name and a number",
    "nowhere": "nowhere: no such folder",
    "--import nowhere": "no such calibration cache",
    "frames --method fp8": "no calibration method 'fp8'; there",
    "frames -n 0": "at least 1 is needed",
    "frames -r nothing": "no recipe nothing",
}
SEARCH = {
    f"search {F} -o out": "give a budget",
    f"search {F} -o out --max-mb 1 --max-joules 0": "--max-joules is 0",
    f"search {F} -o out --max-mb 1 --max-ms 1e-9": r"nothing fits .* 0\.000000000001 s",
    f"search {F} -o out --max-ms 1 --target tensorrt": "use --target onnxruntime",
    f"search {F} -o out --max-mb 0.0000001": "nothing fits",
    f"search {F} -o out --max-mb 1 --scheme int4": "no scheme int4; there are .*int8",
}
OTHERS = {
    "export vad-huge -o out.onnx": "vad-huge",
    "compare dense.onnx path.onnx frames": "no tensor in common",
    "compare dense.onnx dense.onnx frames --float in.onnx": "--float is for --outputs",
    "compare dense.onnx frames --outputs none": "none: no such folder",
    "compare dense.onnx frames --outputs frames": "the dump is of another graph",
    "frames vad-huge -o out": "vad-huge: no such file; models that ship",
    "inspect old.onnx": GONE,
    "plan old.onnx": GONE,
    "plan pick.onnx": KEPT,
    "compare old.onnx old.onnx frames": GONE,
    "sensitivity old.onnx frames -o out.toml": GONE,
    "plan latin.json": r"latin\.json: not a plan",
    "inspect open.onnx --set-dim n": "write NAME=SIZE, e.g. batch=1",
    "inspect open.onnx --set-dim n=x": "write NAME=SIZE, e.g. batch=1",
    "inspect open.onnx --set-dim n=0": "n=0 must be 1 or more",
    "inspect open.onnx --set-dim rows=1": "is called 'rows'; there is n",
    "lint dense.onnx --target npu": "no target 'npu'; there are tensorrt",
    "lint dense.onnx --target onnxruntime --trt-check": "--trt-check is for tensorrt",
    "lint dense.onnx --target-version ten": "target-version: 'ten' is no version of",
    "lint dense.onnx --sm 75": "--sm 75 is for --trt-check, which is not given",
    "lint dense.onnx --target-version 10": "'10' is no version of TensorRT, such as",
    "lint dense.onnx --target onnxruntime --target-version 10.13": (
        "--target-version is for tensorrt, not for onnxruntime"
    ),
    "lint dense.onnx --provider cpu{plugins=[in.onnx]}": (
        "lint for tensorrt opens no session"
    ),
    "list wheels": "no kind 'wheels'; there are passes, rules",
    f"{TIMED} --energy sun": "no energy counter 'sun'; there are nvml, recorded",
    f"{TIMED} --energy recorded:no.csv": r"no\.csv: No such file",
}
DRIVE = {
    "--routes nowhere": "no route 'nowhere'",
    "--routes 1 --render nowhere": "no route 'nowhere'",
    "--routes 1 --engine cloud": "no engine 'cloud'",
    "--routes 1 --engine local:a:1": "no engine 'local:a:1'",
    "--routes 1 --weather snow=1": "weather option snow: Unexpected",
    "--routes 1 --weather night=dark": "weather option night",
    "--routes 1 --latency fast": "no latency source 'fast'",
}
SCORE = {
    "score nodir": "nodir: no such folder$",
    "score frames": "not a results folder",
    "score results --metrics frames": "no results of a real run, which --metr",
}
LINES = {
    **{f"compress {words}": said for words, said in COMPRESS.items()},
    **{f"calibrate dense.onnx {w} -o out.json": said for w, said in CALIBRATE.items()},
    **{f"evaluate blind {w} -o out": said for w, said in DRIVE.items()},
    **SEARCH,
    **OTHERS,
    **SCORE,
}
OVERRIDES = {
    "int4": '[[override]]\nop = "MatMul"\ndtype = "int4"',
    "node": '[[override]]\nnodes = "/radar/*"\ndtype = "float"',
    "module": '[[override]]\nmodule = "radar"\ndtype = "float"',
    "reads": '[[override]]\nreads = "radar"\ndtype = "float"',
    "radar": '[modules.radar]\nrole = "feature"\npatterns = ["radar_net"]\n',
}
RANGES: Mapping[str, Mapping[str, Any]] = {
    "nan": {"tensors": {"a": [float("nan"), 1]}},
    "inf": {"tensors": {"a": [-1, float("inf")]}},
    "large": {"tensors": {"a": [-1e39, 1]}},
    "turned": {"tensors": {"a": [2, 1]}},
    "no-frames": {"frames": 0},
    "other-graph": {"model": "another"},
    "other-frames": {"source": "others"},
}
FRAMES: Mapping[str, Mapping[str, np.ndarray]] = {
    "wrong-name": {"radar": np.zeros((1, 4), np.float32)},
    "wrong-shape": {"camera": np.zeros((1, 5), np.float32)},
    "wrong-dtype": {"camera": np.zeros((1, 4), np.float64)},
    "nan": {"camera": np.full((1, 4), np.nan, np.float32)},
    "inf": {"camera": np.full((1, 4), np.inf, np.float32)},
    "cut": {"camera": np.zeros((1, 4), np.float32)},
}
OPEN = """m (float[n,4] camera) => (float[n,4] plan) {
    ["/backbone/Relu"] f = Relu(camera)
    ["/occ_head/NonZero"] i = NonZero(f)
    ["/occ_head/Cast"] c = Cast<to=1>(i)
    ["/occ_head/Sum"] s = ReduceMax<keepdims=0, axes=[0]>(c)
    ["/plan_head/Sum"] t = ReduceSum(s)
    ["/plan_head/Add"] plan = Add(f, t) }"""

GRAPHS = {
    "open": OPEN,
    "path": "m (float[4,16] camera) => (float[4,16] path) { path = Relu(camera) }",
    "old": """<ir_version: 3, opset_import: ["" : 6]>
m (float[4,16] camera) => (float[4,16] plan) <float[4] w = {1, 2, 3, 4}> {
    r = Relu(camera) plan = Add<axis=0, broadcast=1>(r, w) }""",
    "lstm": """m (float[4,16] camera) => (float[4,1,1,16] plan)
    <int64[3] one = {4, 1, 16}, int64[3] rows = {1, 64, 16}> {
    x = Reshape(camera, one) w = ConstantOfShape(rows)
    plan = LSTM<hidden_size=16>(x, w, w) }""",
}
PICK = """<ir_version: 8, opset_import: ["" : 11]>
m (float[4,16] camera, float[16,32] w) => (float[4,32] plan) {
    a = MatMul(camera, w) ["pick"] plan = Hardmax<axis=1>(a) }"""


@pytest.fixture
def folder(dense: Path, cli: Cli) -> Path:
    """The folder of a dense model, and all that can be wrong beside it."""
    whole = (dense / "in.onnx").read_bytes()
    (dense / "cut.onnx").write_bytes(whole[:-40])
    (dense / "junk.onnx").write_text("this is no graph")
    for name in ("latin.toml", "latin.json"):
        (dense / name).write_bytes("caf\u00e9".encode("latin-1"))
    for name, text in OVERRIDES.items():
        (dense / f"{name}.toml").write_text(text)
    for name, arrays in FRAMES.items():
        write_frames(dense / name, **arrays)
    first = dense / "cut" / "000000.npz"
    first.write_bytes(first.read_bytes()[:-40])
    for name in ("empty", "results"):
        (dense / name).mkdir()
    manifest = json.dumps({"routes": ["a"], VERSION: ROAD_VERSION})
    (dense / "results" / "evaluation.json").write_text(manifest)
    for name, text in GRAPHS.items():
        save_text(dense / f"{name}.onnx", text)
    eye = np.eye(16, 32, dtype=np.float32)
    graph.save(stored(parsed(PICK), {"w": eye}), dense / "pick.onnx")
    model = graph.load(dense / "in.onnx")
    big = np.random.default_rng(0).normal(size=(1, 4096)).astype(np.float32)
    rewrite.add_constant(model.graph, big, "w")
    graph.save(model, dense / "apart.onnx", external=True)
    (dense / "apart.onnx.data").unlink()
    return dense


@pytest.mark.parametrize("line", LINES)
def test_what_is_wrong_is_one_line(cli: Cli, folder: Path, line: str) -> None:
    if any(name in line for name in (f"{each}.json" for each in RANGES)):
        write_ranges(cli, folder)

    assert re.search(LINES[line], cli.refused(line))


def write_ranges(cli: Cli, folder: Path) -> None:
    """Calibrate, and spoil the result in every way."""
    cli.done("calibrate dense.onnx frames --map map.toml -o good.json")
    good = json.loads((folder / "good.json").read_text())
    for name, change in RANGES.items():
        tensors = {**good["tensors"], **change.get("tensors", {})}
        text = json.dumps({**good, **change, "tensors": tensors})
        (folder / f"{name}.json").write_text(text)
