"""``compress``: the file, its report, and what could not be proven of it."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from tests.support.command import Cli, write_frames
from tests.support.frames import record
from tests.support.nets import parsed, save_text, stored

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
    model.metadata_props["me2e.weights"] = "a.pth"
    graph.save(model, files / "in.onnx")

    assert "weights: a.pth" in cli.done(f"{ABLATE} -o out.onnx").out
    assert json.loads((files / "out.report.json").read_text())["weights"] == "a.pth"


@pytest.mark.parametrize("target", ["tensorrt", "onnxruntime"])
def test_a_graph_that_is_quantized_already_is_refused(
    cli: Cli, dense: Path, target: str
) -> None:
    cli.done(f"compress dense.onnx {INT8} --target {target} -o int8.onnx")
    said = cli.refused(f"compress int8.onnx {INT8} -o out.onnx")
    assert "quantized already: " in said
    assert "give the float graph that it was made of" in said
    assert "quantized already" in cli.refused("calibrate int8.onnx frames -o r.json")


@pytest.mark.parametrize(
    ("zero", "offered"), [("int8 z = {0}", True), ("int8 z = {3}", False),
                          ("uint8 z = {0}", False), ("uint8 z = {128}", False)]
)  # fmt: skip
def test_lower_int8_is_offered_of_what_it_takes_alone(
    cli: Cli, dense: Path, zero: str, offered: bool
) -> None:
    save_text(dense / "m.onnx", "m (float[4,16] camera) => (float[4,16] plan)"
              f" <float s = {{0.1}}, {zero}> {{ q = QuantizeLinear(camera, s, z)"
              " plan = DequantizeLinear(q, s, z) }")  # fmt: skip

    said = cli.refused("compress m.onnx -r full --frames frames -o out.onnx")
    assert ("lower-int8" in said) is offered
    lowered = cli("compress m.onnx --passes lower-int8 --frames frames -o low.onnx")
    assert (lowered.code == 0) is offered


@pytest.mark.parametrize("shape", ["1,4", "N,4"])
@pytest.mark.parametrize("head", ["", '<ir_version: 3, opset_import: ["" : 6]>'])
def test_a_graph_of_no_known_stack_or_of_old_is_one_module(
    cli: Cli, tmp_path: Path, shape: str, head: str
) -> None:
    body = "{ a = Identity(x)\n y = Relu(a) }"
    text = f"{head}m (float[{shape}] x) => (float[{shape}] y) {body}"
    save_text(tmp_path / "plain.onnx", text)
    cli.done("compress plain.onnx -r exact -o out.onnx")
    assert kinds(tmp_path / "out.onnx") == ["Relu"]


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


def test_what_cannot_run_is_written_on_demand_alone(cli: Cli, tmp_path: Path) -> None:
    graph.save(parsed(HEAD + PLUGIN), tmp_path / "in.onnx")
    line = "compress in.onnx -r exact -o out.onnx"

    said = cli.refused(line)
    assert "not proven that import-normalize, eliminate-redundant left" in said
    assert "no operator trt.plugins::Rotate (node '/occ_head/Rotate')" in said
    assert said.endswith("nothing is written; --verify-frames 0 writes it unproven")
    (check,) = cli.document(f"{line} --verify-frames 0")["verifications"]
    assert kinds(tmp_path / "out.onnx") == ["Rotate", "Neg"]
    assert not check["proven"]
    assert check["skipped"] == "no frame was asked for (--verify-frames 0)"


def test_an_open_dimension_is_proven_at_drawn_sizes_unless_nobody_asks(
    cli: Cli, tmp_path: Path
) -> None:
    graph.save(parsed(HEAD + OPEN), tmp_path / "in.onnx")

    shown = cli.done("compress in.onnx -r exact -o a.onnx").words
    assert "every output is the same (synthetic, n=2" in shown
    assert "not proven" not in shown
    shown = cli.done("compress in.onnx -r exact -o b.onnx --verify-frames 0").words
    said = "not proven: import-normalize, eliminate-redundant: no frame was asked for"
    assert said in shown
    assert "every output is the same" not in shown


def test_an_open_batch_gets_one_size_in_every_command(cli: Cli, tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    weights = {"w": draws.normal(size=(32, 16, 3, 3)), "l": draws.normal(size=(64, 32))}
    model = stored(
        parsed(
            """m (float[batch,16,8,8] image, float[32,16,3,3] w, float[64,32] l)
            => (float[batch,64] y) <int64[2] flat = {-1, 32}> {
        a = Conv(image, w) p = GlobalAveragePool(a)
        f = Reshape(p, flat) y = Gemm<transB=1>(f, l) }"""
        ),
        {name: array.astype(np.float32) for name, array in weights.items()},
    )
    graph.save(model, tmp_path / "m.onnx")
    frame = draws.normal(size=(1, 16, 8, 8)).astype(np.float32)
    record(tmp_path / "frames", [{"image": frame}] * 2)

    cli.done("compress m.onnx -r exact --set-dim batch=1 -o s.onnx")
    cli.done("plan s.onnx")
    cli.done("lint s.onnx")
    cli.done("calibrate s.onnx frames -o r.json")
    cli.done("compress s.onnx -r full --ranges r.json -o a.onnx")
    cli.done("search s.onnx frames --max-mb 1 -o b.toml")
    cli.done("sensitivity s.onnx frames --limit 9 -o c.toml")
    for name in "bc":
        cli.done(f"compress s.onnx -r {name}.toml --frames frames -o {name}.onnx")
    for name in "abc":
        sized = graph.load(tmp_path / f"{name}.onnx")
        assert str(sized.graph.inputs[0].shape) == "[1,16,8,8]"


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


POOLED = """
    m (float[1,16,8,8] x) => (float[%s] y)
    <int64[8] p = {0,0,1,1,0,0,1,1}, float[16,16,1,1] w = {%s}> {
        a = Tanh(x) b = Pad(a, p)
        ["/backbone/MaxPool"] c = MaxPool<kernel_shape=[3,3]>(b)
        ["/backbone/Conv"] d = Conv(c, w)
        ["/backbone/End"] y = %s(d)
    }
"""
LINTED = "compress pooled.onnx --frames pictures -o o.onnx"
PLANNED = "--scheme full --rules paper --target"


def pooled(folder: Path, end: str = "Relu", shape: str = "1,16,8,8") -> None:
    weight = ",".join(str(number) for number in range(256))
    model = parsed(POOLED % (shape, weight, end))
    graph.save(model, folder / "pooled.onnx")
    draws = np.random.default_rng(0).normal(size=(1, 16, 8, 8))
    write_frames(folder / "pictures", x=draws.astype(np.float32))


def test_what_the_target_computes_otherwise_is_an_alert(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("onnxruntime.__version__", "1.31.0")
    pooled(tmp_path)

    found = cli.document(f"{LINTED} {PLANNED} onnxruntime")

    assert found["status"] == "warning"
    assert "lint: o.onnx for onnxruntime: 0 errors, 1 wrong" in str(found["verdict"])
    assert "padded-pool '/backbone/MaxPool'" in found["verdict"][-1]
    (row,) = found["lint"]
    assert (row["severity"], row["rule"], row["nodes"]) == ("wrong", "padded-pool", 1)
    assert cli("lint o.onnx --target onnxruntime").code == 1


@pytest.mark.parametrize(
    ("target", "code", "status"),
    [
        (f"{PLANNED} tensorrt", 1, "refused"),
        ("--passes quantize-int8{rules=paper,target=tensorrt}", 0, "warning"),
    ],
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
