"""What users get wrong: one line that names the culprit, exit 1, nothing changed."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph, rewrite
from tests.cli.conftest import Command, write_frames

Words = list[str | Path]


def snapshot(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture
def refused(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Run a command that must be refused; give the line that it says."""

    def run(*words: str | Path) -> str:
        before = snapshot(files)
        assert command(*words) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert snapshot(files) == before
        return lines[0]

    return run


def compress(
    files: Path,
    *more: str | Path,
    model: str = "in.onnx",
    passes: str = "fold-constants",
) -> Words:
    output: Words = ["-o", files / "out.onnx", "--map", files / "map.toml"]
    return ["compress", files / model, "--passes", passes, *output, *more]


def test_not_an_onnx_file(refused: Callable[..., str], files: Path) -> None:
    (files / "junk.onnx").write_text("this is no graph")
    line = refused(*compress(files, model="junk.onnx"))
    assert "junk.onnx: not an ONNX" in line


def test_a_truncated_file(refused: Callable[..., str], files: Path) -> None:
    whole = (files / "in.onnx").read_bytes()
    (files / "cut.onnx").write_bytes(whole[:-40])
    assert "cut.onnx" in refused(*compress(files, model="cut.onnx"))


def test_missing_external_data(refused: Callable[..., str], files: Path) -> None:
    model = graph.load(files / "in.onnx")
    big = np.random.default_rng(0).normal(size=(1, 4096)).astype(np.float32)
    rewrite.add_constant(model.graph, big, "w")
    graph.save(model, files / "ext.onnx", external=True)
    (files / "ext.onnx.data").unlink()
    line = refused(*compress(files, model="ext.onnx"))
    assert "ext.onnx.data is missing" in line


def test_no_such_file(refused: Callable[..., str], files: Path) -> None:
    assert "none.onnx: no such file" in refused(*compress(files, model="none.onnx"))


def test_the_output_is_the_input(refused: Callable[..., str], files: Path) -> None:
    words = ("--passes", "fold-constants", "-o", files / "in.onnx")
    line = refused("compress", files / "in.onnx", *words)
    assert "in.onnx is the input" in line


def test_no_folder_for_the_output(refused: Callable[..., str], files: Path) -> None:
    words = ("--passes", "fold-constants", "-o", files / "no" / "out.onnx")
    assert "no such folder" in refused("compress", files / "in.onnx", *words)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fold", "no pass 'fold'"),
        ("fold-constants{speed=9}", "fold-constants has no option 'speed'"),
        ("ablate-modules{drop=[occ", "a comma or ] is expected"),
        ("ablate-modules{drop=7}", "ablate-modules: drop"),
    ],
)
def test_an_unknown_pass_or_option(
    refused: Callable[..., str], files: Path, text: str, message: str
) -> None:
    assert message in refused(*compress(files, passes=text))


def test_an_unknown_recipe(refused: Callable[..., str], files: Path) -> None:
    words = ("-r", "nothing", "-o", files / "out.onnx")
    assert "no recipe nothing" in refused("compress", files / "in.onnx", *words)


def test_nothing_to_do(refused: Callable[..., str], files: Path) -> None:
    line = refused("compress", files / "in.onnx", "-o", files / "out.onnx")
    assert "say what to do" in line


def test_a_map_pattern_that_matches_nothing(
    refused: Callable[..., str], files: Path
) -> None:
    (files / "map.toml").write_text(
        '[modules.radar]\nrole = "feature"\npatterns = ["radar_net"]\n'
    )
    line = refused(*compress(files))
    assert "'radar_net' of module radar matches no" in line


def test_a_map_that_is_not_there(refused: Callable[..., str], files: Path) -> None:
    (files / "map.toml").unlink()
    assert "map.toml: no such file" in refused(*compress(files))


def test_a_module_nobody_has(refused: Callable[..., str], files: Path) -> None:
    line = refused(*compress(files, passes="ablate-modules{drop=[radar]}"))
    assert "radar: no such module" in line


def test_a_module_that_owns_an_output(refused: Callable[..., str], files: Path) -> None:
    line = refused(*compress(files, passes="ablate-modules{drop=[planner]}"))
    assert "planner cannot be dropped: it makes plan" in line


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"radar": np.zeros((1, 4), np.float32)}, "camera"),
        ({"camera": np.zeros((1, 5), np.float32)}, "5"),
        ({"camera": np.zeros((1, 4), np.float64)}, "float64"),
        ({"camera": np.full((1, 4), np.nan, np.float32)}, "nan"),
        ({"camera": np.full((1, 4), np.inf, np.float32)}, "inf"),
    ],
    ids=["name", "shape", "dtype", "nan", "inf"],
)
def test_frames_of_something_else(
    refused: Callable[..., str],
    files: Path,
    arrays: dict[str, np.ndarray],
    message: str,
) -> None:
    write_frames(files / "wrong", **arrays)
    line = refused(*compress(files, "--frames", files / "wrong"))
    assert "000000.npz" in line
    assert message in line.lower()


def test_no_frames_at_all(refused: Callable[..., str], files: Path) -> None:
    (files / "empty").mkdir()
    line = refused(*compress(files, "--frames", files / "empty"))
    assert "empty: holds no .npz frames" in line


def test_int8_without_frames(refused: Callable[..., str], dense: Path) -> None:
    line = refused(*compress(dense, "--scheme", "full", model="dense.onnx"))
    assert "frames" in line


def test_an_unknown_stack(refused: Callable[..., str], files: Path) -> None:
    line = refused("export", "vad-huge", "-o", files / "m.onnx")
    assert "vad-huge" in line


def test_an_opset_nobody_writes(refused: Callable[..., str], files: Path) -> None:
    line = refused("export", "vad-tiny", "-o", files / "m.onnx", "--opset", "99")
    assert "opset 99" in line


def test_weights_that_are_no_checkpoint(
    refused: Callable[..., str], files: Path
) -> None:
    weights = files / "in.onnx"
    line = refused("export", "tcp", "--weights", weights, "-o", files / "m.onnx")
    assert f"{weights}: not read as weights: neither a file of torch.save" in line


def test_a_comparison_without_a_common_output(
    refused: Callable[..., str], files: Path
) -> None:
    other = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[1,4] camera) => (float[1,4] path) { path = Relu(camera) }"
    )
    graph.save(other, files / "other.onnx")
    words = (files / "in.onnx", files / "other.onnx", files / "frames")
    assert "no output in common" in refused("compare", *words)


def test_dynamic_shapes_work_where_nothing_needs_them(
    command: Command, files: Path
) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        'm (float[N,4] camera) => (float[N,4] plan) { ["/backbone/I"] a ='
        ' Identity(camera)\n ["/plan_head/Relu"] plan = Relu(a) }'
    )
    graph.save(model, files / "open.onnx")
    assert command(*compress(files, model="open.onnx")) == 0


def test_zeros_of_an_open_shape_are_refused(
    refused: Callable[..., str], files: Path
) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[N,4] camera) => (float[N,4] plan) {"
        ' ["/backbone/Relu"] f = Relu(camera)\n'
        ' ["/occ_head/NonZero"] i = NonZero(f)\n'
        ' ["/occ_head/Cast"] c = Cast<to=1>(i)\n'
        ' ["/occ_head/Sum"] s = ReduceMax<keepdims=0, axes=[0]>(c)\n'
        ' ["/plan_head/Sum"] t = ReduceSum(s)\n'
        ' ["/plan_head/Add"] plan = Add(f, t) }'
    )
    graph.save(model, files / "open.onnx")
    words = compress(files, model="open.onnx", passes="ablate-modules{drop=[occ]}")
    assert "zeros or a mean need a static one" in refused(*words)
