"""For whom int8 is written where nobody is named, and what is said of other files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import RecipeError
from me2e_compress.commands.lint import with_target
from me2e_compress.commands.options import LintOptions
from me2e_compress.graph.provenance import decompressed
from me2e_compress.manager import recipe
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.decision import plan_of
from me2e_compress.runtime.providers import CudaProvider
from me2e_compress.simulator.routes import save_routes
from tests.evaluators.highway.drivers import PARKED, slow_here, straight_on
from tests.support.command import Cli, write_frames

CONVOLUTIONS = """
    <ir_version: 9, opset_import: ["" : 17]>
    m (float[1,16,8,8] x) => (float[1,16,8,8] y)
    <float[16,16,1,1] w = {%s}, float[16,16,1,1] v = {%s}> {
        ["/backbone/One"] a = Conv(x, w) ["/backbone/Relu"] b = Relu(a)
        ["/backbone/Two"] c = Conv(b, v) ["/backbone/End"] y = Relu(c)
    }
"""
INT8 = "compress m.onnx --scheme full --rules paper --frames frames"
SLOW = "it is quantized in TensorRT's form, slow in onnxruntime's CPU"
FAST = "--target onnxruntime writes what is fast here"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    draws = np.random.default_rng()
    weights = (
        ",".join(f"{number:.4f}" for number in draws.normal(size=256)) for _ in "wv"
    )
    graph.save(ir.from_onnx_text(CONVOLUTIONS % tuple(weights)), tmp_path / "m.onnx")
    frame = draws.normal(size=(1, 16, 8, 8)).astype(np.float32)
    write_frames(tmp_path / "frames", x=frame)
    return tmp_path


def grids(path: Path) -> set[ir.DataType]:
    """The types that activations are quantized to."""
    nodes = graph.load(path).graph
    zeros = [node.inputs[2] for node in nodes if node.op_type == "QuantizeLinear"]
    return {zero.dtype for zero in zeros if zero is not None and zero.dtype is not None}


def test_int8_is_for_onnxruntime_unless_another_is_named(cli: Cli, model: Path) -> None:
    def report() -> Any:
        return json.loads((model / "out.report.json").read_text())

    shown = cli.done(f"{INT8} -o out.onnx").words
    assert grids(model / "out.onnx") == {ir.DataType.UINT8}
    assert "out.onnx for onnxruntime: 0 errors, 0 warnings" in shown
    assert "TensorRT's form" not in shown
    assert report()["int8"]["slow_here"] is None

    shown = cli.done(f"{INT8} --target tensorrt -o out.onnx").words
    assert grids(model / "out.onnx") == {ir.DataType.INT8}
    assert SLOW in shown
    assert FAST in shown
    assert report()["int8"]["slow_here"].startswith(SLOW)
    assert any(SLOW in line for line in report()["verdict"])


@pytest.mark.usefixtures("dense")
def test_a_product_that_is_fast_here_is_in_tensorrts_form_all_the_same(
    cli: Cli,
) -> None:
    """A MatMul without a bias answers float at full speed; its target is said."""
    line = "compress dense.onnx --scheme full --frames frames --map map.toml"

    shown = cli.done(f"{line} --target tensorrt -o out.onnx").words

    assert SLOW in shown
    assert SLOW not in cli.done("profile out.onnx frames -o t.json").words


@pytest.mark.usefixtures("model")
@pytest.mark.parametrize("written_for", ["tensorrt", "onnxruntime"])
def test_lint_asks_whom_a_file_was_written_for(cli: Cli, written_for: str) -> None:
    cli.done(f"{INT8} --target {written_for} -o out.onnx")

    assert f"out.onnx for {written_for}: 0 errors" in cli.done("lint out.onnx").out
    assert cli.document("lint out.onnx")["target"] == written_for


def test_lint_asks_tensorrt_of_files_that_do_not_say(cli: Cli, model: Path) -> None:
    assert cli.document("lint m.onnx")["target"] == "tensorrt"
    cli.done(f"{INT8} -o out.onnx")
    # a plan of before it told its target, and none
    made = graph.load(model / "out.onnx")
    plan = json.loads(decompressed(made.metadata_props.pop("me2e.quant_plan")))
    graph.save(made, model / "other.onnx")
    plan.pop("target")
    made.metadata_props["me2e.quant_plan"] = json.dumps(plan)
    graph.save(made, model / "older.onnx")

    for file in ("other.onnx", "older.onnx"):
        assert cli.document(f"lint {file}", code=1)["target"] == "tensorrt"
    for option in ("--target tensorrt", "--target-version 10.13"):
        assert cli.document(f"lint out.onnx {option}", code=1)["target"] == "tensorrt"
    assert with_target(made, LintOptions(trt_check=True)).target == "tensorrt"


def test_a_provider_is_for_whom_opens_a_session(model: Path, cli: Cli) -> None:
    cli.done(f"{INT8} -o out.onnx")
    options = LintOptions(provider=CudaProvider())

    loaded = graph.load(model / "out.onnx")
    assert with_target(loaded, options).provider == CudaProvider()
    with pytest.raises(RecipeError, match="lint for tensorrt opens no session"):
        with_target(graph.load(model / "m.onnx"), options)


def test_lowered_int8_is_for_onnxruntime(cli: Cli, model: Path) -> None:
    cli.done(f"{INT8} --target tensorrt -o trt.onnx")
    passes = "--passes import-normalize,lower-int8 --frames frames"

    cli.done(f"compress trt.onnx {passes} -o cpu.onnx")

    plan = plan_of(graph.load(model / "cpu.onnx"))
    assert plan is not None
    assert plan.target == cli.document("lint cpu.onnx")["target"] == "onnxruntime"
    assert cli.document("profile cpu.onnx frames -o t.json")["slow_here"] is None


@pytest.mark.usefixtures("model")
def test_profile_and_compare_say_it_of_files_of_whoever(cli: Cli, model: Path) -> None:
    cli.done(f"{INT8} --target tensorrt -o out.onnx")
    # others write no plan
    other = graph.load(model / "out.onnx")
    other.metadata_props.clear()
    graph.save(other, model / "other.onnx")

    found = cli.document("profile other.onnx frames -o t.json")
    assert found["slow_here"].startswith(SLOW)
    assert "--passes import-normalize,lower-int8" in found["slow_here"]
    assert found["status"] == "warning"
    assert (
        f"other.onnx: {SLOW}" in cli.done("profile other.onnx frames -o t.json").words
    )
    held = cli.document("compare m.onnx other.onnx frames")
    assert list(held["slow_here"]) == ["other.onnx"]
    assert f"other.onnx: {SLOW}" in cli.done("compare m.onnx other.onnx frames").words
    # of other files nothing is said
    cli.done(f"{INT8} -o out.onnx")
    for file in ("m.onnx", "out.onnx"):
        assert cli.document(f"profile {file} frames -o t.json")["slow_here"] is None
    assert SLOW not in cli.done("profile out.onnx frames -o t.json").words
    assert cli.document("compare m.onnx out.onnx frames")["slow_here"] == {}


@pytest.mark.usefixtures("short")
def test_evaluate_says_it_of_the_file_that_drives(cli: Cli, tmp_path: Path) -> None:
    save_routes((PARKED,), tmp_path / "routes.json")
    slow_here(tmp_path / "slow.onnx")
    straight_on(tmp_path / "float.onnx")

    line = "--routes routes.json --latency none -o"
    slow = cli.document(f"evaluate slow.onnx {line} slow")
    plain = cli.document(f"evaluate float.onnx {line} float")

    assert slow["slow_here"].startswith(SLOW)
    assert f"slow.onnx: {slow['slow_here']}" in slow["verdict"]
    assert plain["slow_here"] is None
    assert not [each for each in plain["verdict"] if SLOW in each]


@pytest.mark.usefixtures("model")
def test_a_plan_is_for_the_target_that_compress_writes_for(cli: Cli) -> None:
    assert cli.document("plan m.onnx")["target"] == "onnxruntime"
    assert cli.document("plan m.onnx --target tensorrt")["target"] == "tensorrt"
    said = cli.done("plan m.onnx --rules paper --target tensorrt").words
    assert "rules paper, for tensorrt: 2 of" in said


def test_recipes_of_trials_are_for_onnxruntime(cli: Cli, model: Path) -> None:
    trial = "m.onnx frames --rules paper"

    cli.done(f"sensitivity {trial} --limit 9 -o a.toml")
    cli.done(f"search {trial} --max-mb 0.0015 -o b.toml")
    cli.done(f"search {trial} --max-mb 0.0015 --target tensorrt -o c.toml")

    made = [recipe.load(model / f"{name}.toml")[-1] for name in "abc"]
    targets = [each.target for each in made if isinstance(each, QuantizeInt8)]
    assert targets == ["onnxruntime", "onnxruntime", "tensorrt"]
    assert "--target onnxruntime" in cli.refused(
        f"search {trial} --max-ms 9 --target tensorrt -o d.toml"
    )
