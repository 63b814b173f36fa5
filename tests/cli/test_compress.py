"""``compress``: the file, its report, and what could not be proven of it."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.graph import rewrite
from tests.command import Cli, write_frames
from tests.frames import record
from tests.nets import conv_attention, image, save_text
from tests.plugins import exported

ABLATE = "compress in.onnx --passes ablate-modules{drop=[occ]} --map map.toml"
INT8 = "--scheme full --frames frames --map map.toml"


def kinds(path: Path) -> Sequence[str]:
    return [node.op_type for node in graph.load(path).graph]


def test_a_pipeline_makes_a_smaller_file_and_a_report_that_repeats_it(
    cli: Cli, files: Path
) -> None:
    assert "ablate-modules" in cli.done(f"{ABLATE} -o a.onnx").out
    assert "Sigmoid" not in kinds(files / "a.onnx")
    record = json.loads((files / "a.report.json").read_text())
    assert record["pipeline"] == 'import-normalize,ablate-modules{drop=["occ"]}'
    assert record["output"]["sha256"] == graph.sha256_of(files / "a.onnx")
    cli.done("compress in.onnx -o b.onnx --map map.toml --passes", record["pipeline"])
    assert (files / "a.onnx").read_bytes() == (files / "b.onnx").read_bytes()


def test_the_checkpoint_is_named(cli: Cli, files: Path) -> None:
    model = graph.load(files / "in.onnx")
    model.metadata_props["me2e.weights"] = '{"file": "a.pth", "sha256": "ab"}'
    graph.save(model, files / "in.onnx")
    line = "weights: a.pth, sha256 ab"

    assert line in cli.done(f"{ABLATE} -o out.onnx").out
    assert json.loads((files / "out.report.json").read_text())["weights"] == line


def test_int8_by_scheme(cli: Cli, dense: Path) -> None:
    scheme = INT8.replace("full", "prediction")
    record = cli.document(f"compress dense.onnx {scheme} -o out.onnx")
    assert record["steps"][-1]["text"] == 'quantize-int8{scheme="prediction"}'
    weights = graph.load(dense / "out.onnx").graph.initializers.values()
    assert ir.DataType.INT8 in [value.dtype for value in weights]


@pytest.mark.parametrize("target", ["tensorrt", "onnxruntime"])
def test_a_graph_that_is_quantized_already_is_refused(
    cli: Cli, dense: Path, target: str
) -> None:
    cli.done(f"compress dense.onnx {INT8} --target {target} -o int8.onnx")
    said = cli.refused(f"compress int8.onnx {INT8} -o out.onnx")
    assert "quantized already: " in said
    assert "give the float graph that it was made of" in said
    assert "quantized already" in cli.refused("calibrate int8.onnx frames -o r.json")


@pytest.mark.parametrize("shape", ["1,4", "N,4"])
def test_a_graph_of_no_known_stack_is_one_module(
    cli: Cli, tmp_path: Path, shape: str
) -> None:
    body = "{ a = Identity(x)\n y = Relu(a) }"
    text = f"m (float[{shape}] x) => (float[{shape}] y) {body}"
    save_text(tmp_path / "plain.onnx", text)
    cli.done("compress plain.onnx -r exact -o out.onnx")
    assert kinds(tmp_path / "out.onnx") == ["Relu"]


def test_the_driver_that_ships_is_judged_on_its_own_frames(cli: Cli) -> None:
    """Its planner tosses a coin on made-up inputs: the plan would go unjudged."""
    (check,) = cli.document("compress highway -r exact -o out.onnx")["verifications"]
    assert check["inputs"] == "recorded"
    assert check["unsteady"] == []
    assert check["errors"]["plan"] < 1e-5
    assert check["errors"]["occupancy"] < 1e-5


def test_a_module_of_the_driver_that_ships_can_be_dropped(cli: Cli) -> None:
    """Its graph spells defaults out, which no pass may tidy up on the way."""
    passes = "ablate-modules{drop=[occ],drop_outputs=true}"
    cli.done(f"compress highway --passes {passes} --verify-frames 0 -o out.onnx")


HEAD = '<ir_version: 9, opset_import: ["" : 17, "trt.plugins" : 1]>\n'
PLUGIN = """m (float[1,4] camera) => (float[1,4] plan) {
    ["/backbone/Identity"] a = Identity(camera)
    ["/occ_head/Rotate"] b = trt.plugins.Rotate<mode=1>(a)
    ["/plan_head/Neg"] plan = Neg(b)
}"""
OPEN = """m (float[n,4] camera, float[1,4] other) => (float[n,4] plan) {
    ["/backbone/Identity"] a = Identity(camera)
    ["/plan_head/Add"] plan = Add(a, other)
}"""


def test_what_cannot_be_run_is_written_on_demand_alone(
    cli: Cli, tmp_path: Path
) -> None:
    graph.save(ir.from_onnx_text(HEAD + PLUGIN), tmp_path / "in.onnx")
    line = "compress in.onnx -r exact -o out.onnx"

    said = cli.refused(line)
    assert "not proven that import-normalize, eliminate-redundant left" in said
    assert "no operator trt.plugins::Rotate (node '/occ_head/Rotate')" in said
    assert said.endswith("nothing is written, --unproven writes it nevertheless")
    (check,) = cli.document(f"{line} --unproven")["verifications"]
    assert kinds(tmp_path / "out.onnx") == ["Rotate", "Neg"]
    assert not check["proven"]
    assert "trt.plugins::Rotate" in check["skipped"]


def test_an_open_dimension_is_proven_at_drawn_sizes_unless_nobody_asks(
    cli: Cli, tmp_path: Path
) -> None:
    graph.save(ir.from_onnx_text(HEAD + OPEN), tmp_path / "in.onnx")

    shown = cli.done("compress in.onnx -r exact -o a.onnx").words
    assert "every output is the same (synthetic, n=2" in shown
    assert "not proven" not in shown
    shown = cli.done("compress in.onnx -r exact -o b.onnx --verify-frames 0").words
    said = "not proven: import-normalize, eliminate-redundant: no frame was asked for"
    assert said in shown
    assert "every output is the same" not in shown


def test_an_open_batch_gets_one_size_in_every_command(cli: Cli, tmp_path: Path) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[batch,16,8,8] image) => (float[batch,64] y)"
        " <int64[2] flat = {-1, 32}> { a = Conv(image, w)"
        " p = GlobalAveragePool(a) f = Reshape(p, flat) y = Gemm<transB=1>(f, l) }"
    )
    draws = np.random.default_rng(0)
    for node, name, shape in (
        (model.graph[0], "w", (32, 16, 3, 3)),
        (model.graph[3], "l", (64, 32)),
    ):
        weight = draws.normal(size=shape).astype(np.float32)
        made = rewrite.add_constant(model.graph, weight, name)
        node.replace_input_with(1, made)
    graph.save(model, tmp_path / "m.onnx")
    frame = draws.normal(size=(1, 16, 8, 8)).astype(np.float32)
    record(tmp_path / "frames", [{"image": frame}] * 2)
    size = "--set-dim batch=1"

    cli.done(f"plan m.onnx {size}")
    cli.done(f"lint m.onnx {size}")
    cli.done(f"calibrate m.onnx frames -o r.json {size}")
    cli.done(f"compress m.onnx -r full --ranges r.json -o a.onnx {size}")
    cli.done(f"search m.onnx frames --max-mb 1 -o b.toml {size}")
    cli.done(f"sensitivity m.onnx frames --limit 9 -o c.toml {size}")
    for name in "bc":
        cli.done(f"compress m.onnx -r {name}.toml --frames frames -o {name}.onnx")
    for name in "abc":
        sized = graph.load(tmp_path / f"{name}.onnx")
        assert str(sized.graph.inputs[0].shape) == "[1,16,8,8]"


FRAME = {
    "image": np.ones((1, 16, 8, 8), np.float32),
    "angle": np.full(1, 30, np.float32),
    "center": np.full(2, 4, np.float32),
    "lidar": np.tile(2 * np.eye(4, dtype=np.float32), (1, 6, 1, 1)),
}
CACHE = "TRT-100700-EntropyCalibration2\n" + "".join(
    f"{name}: 3c010204\n" for name in ("image", "again", "turned", "y")
)


@pytest.fixture
def plugins(tmp_path: Path) -> Path:
    """bare.onnx and shaped.onnx: without and with value_info for the plugins."""
    graph.save(exported(shapes=False), tmp_path / "bare.onnx")
    graph.save(exported(shapes=True), tmp_path / "shaped.onnx")
    record(tmp_path / "frames", [FRAME] * 4)
    return tmp_path


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize("name", ["inspect", "plan", "lint"])
def test_plugins_without_shapes_are_told_of_and_with_them_are_not(
    cli: Cli, name: str
) -> None:
    assert "value_info" in "".join(cli.done(f"{name} bare.onnx").out.split())
    if name != "lint":
        assert "value_info" not in "".join(cli.done(f"{name} shaped.onnx").out.split())


@pytest.mark.usefixtures("plugins")
def test_plugins_run_where_nobody_has_their_library(cli: Cli) -> None:
    said = cli.done("compress bare.onnx -r exact -o bare-small.onnx --unproven").err
    assert "2 plugin nodes (RotateTRT2, InverseTRT) tell no shape" in " ".join(
        said.split()
    )
    how = "-r full --frames frames --floor 0"
    cli.done(f"compress shaped.onnx {how} -o small.onnx")
    cli.done("compare shaped.onnx small.onnx frames")


def test_ranges_of_tensorrt_make_int8_of_a_plugin_that_nobody_runs(
    cli: Cli, plugins: Path
) -> None:
    unknown = graph.load(plugins / "shaped.onnx")
    unknown.graph[1].op_type = "VendorsOwn"
    graph.save(unknown, plugins / "unknown.onnx")
    (plugins / "trt.cache").write_text(CACHE)

    said = cli.refused("calibrate unknown.onnx frames -o r.json")
    assert "calibrate --import CACHE" in said
    cli.done("calibrate shaped.onnx --import trt.cache -o r.json")
    cli.done("compress shaped.onnx -r full --ranges r.json -o int8.onnx")
    assert "QuantizeLinear" in kinds(plugins / "int8.onnx")


def test_what_compress_wrote_can_be_compressed_again(cli: Cli, plugins: Path) -> None:
    cli.done("compress shaped.onnx -r exact -o small.onnx")
    nodes = graph.load(plugins / "small.onnx").graph
    domains = {node.op_type: node.domain for node in nodes}
    assert (domains["RotateTRT2"], domains["InverseTRT"]) == ("", "")
    cli.done("compress small.onnx -r exact -o again.onnx")


@pytest.mark.opens_apart
def test_a_graph_that_kills_onnxruntime_is_one_line(cli: Cli, tmp_path: Path) -> None:
    """It divides the least integer by -1 while it opens this graph, and dies."""
    save_text(
        tmp_path / "deadly.onnx",
        """deadly (float[1,4] camera) => (float[1,4] plan, int32[1] count)
        <int32[1] least = {-2147483648}, int32[1] minus = {-1}> {
            plan = Relu(camera)
            count = Div(least, minus)
        }""",
    )
    write_frames(tmp_path / "frames", camera=np.zeros((1, 4), np.float32))

    assert cli("compare deadly.onnx deadly.onnx frames").err.splitlines()[-1] == (
        "me2e-compress: deadly.onnx: onnxruntime dies of it (SIGFPE) at step open"
    )


M = "../models/m.onnx"
FROM_ELSEWHERE = (
    f"inspect {M}",
    f"plan {M}",
    f"lint {M}",
    f"calibrate {M} ../models/frames -o r.json",
    f"compare {M} {M} ../models/frames",
    f"profile {M} ../models/frames -o t.json",
    f"compress {M} -r full --frames ../models/frames -o small.onnx",
)


@pytest.fixture
def elsewhere(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cli:
    """A folder that is not the model's, whose weights lie all apart."""
    home, away = tmp_path / "models", tmp_path / "elsewhere"
    home.mkdir()
    model = conv_attention()
    for node in model.graph:
        node.metadata_props.clear()
    ir.save(
        *(model, home / "m.onnx", "protobuf"),
        external_data="weights.bin",
        size_threshold_bytes=0,
    )
    record(home / "frames", [image(0), image(1)])
    away.mkdir()
    monkeypatch.chdir(away)
    return Cli(cli.command, away, cli.capsys)


@pytest.mark.parametrize("line", FROM_ELSEWHERE)
def test_a_model_with_external_weights_works_from_any_folder(
    elsewhere: Cli, line: str
) -> None:
    elsewhere.done(line)


@pytest.mark.parametrize("at", [0, 2, 6])
def test_weights_outside_the_model_s_folder_are_not_read(
    elsewhere: Cli, tmp_path: Path, at: int
) -> None:
    weights = tmp_path / "models" / "weights.bin"
    weights.rename(tmp_path / "private.bin")
    weights.symlink_to(tmp_path / "private.bin")

    said = elsewhere.refused(FROM_ELSEWHERE[at])

    assert "the data of tokens lie at 'weights.bin'" in said
    assert "private.bin, outside the model's folder: not read" in said


POOLED = """
    <ir_version: 9, opset_import: ["" : 17]>
    m (float[1,16,8,8] x) => (float[%s] y)
    <int64[8] p = {0,0,1,1,0,0,1,1}, float[16,16,1,1] w = {%s}> {
        a = Tanh(x) b = Pad(a, p)
        ["/backbone/MaxPool"] c = MaxPool<kernel_shape=[3,3]>(b)
        ["/backbone/Conv"] d = Conv(c, w)
        ["/backbone/End"] y = %s(d)
    }
"""
LINTED = "compress pooled.onnx --scheme full --rules paper --frames pictures -o o.onnx"


def pooled(folder: Path, end: str = "Relu", shape: str = "1,16,8,8") -> None:
    weight = ",".join(str(number) for number in range(256))
    model = ir.from_onnx_text(POOLED % (shape, weight, end))
    graph.save(model, folder / "pooled.onnx")
    draws = np.random.default_rng(0).normal(size=(1, 16, 8, 8))
    write_frames(folder / "pictures", x=draws.astype(np.float32))


def test_what_the_target_computes_otherwise_is_an_alert(
    cli: Cli, tmp_path: Path
) -> None:
    pooled(tmp_path)

    found = cli.document(f"{LINTED} --target onnxruntime")

    assert found["status"] == "warning"
    assert "lint: o.onnx for onnxruntime: 0 errors, 1 wrong" in str(found["verdict"])
    assert "padded-pool '/backbone/MaxPool'" in found["verdict"][-1]
    (row,) = found["lint"]
    assert (row["severity"], row["rule"], row["nodes"]) == ("wrong", "padded-pool", 1)
    assert cli("lint o.onnx --target onnxruntime").code == 1


@pytest.mark.parametrize(
    ("target", "code", "status"),
    [("--target tensorrt", 1, "refused"), ("", 0, "warning")],
)
def test_a_target_that_is_named_must_take_what_is_written(
    cli: Cli, tmp_path: Path, target: str, code: int, status: str
) -> None:
    pooled(tmp_path, "Det", "1,16")

    said = cli(f"{LINTED} {target}")
    found = cli.document(f"{LINTED} {target}", code=code)

    assert said.code == code
    assert found["status"] == status
    alert = "o.onnx: tensorrt refuses it, 1 error; operator '/backbone/End'"
    assert f"lint: {alert}" in found["verdict"][-1]
    assert (f"written, but {alert}" in said.err) == bool(code)
    assert "Det" in kinds(tmp_path / "o.onnx")
