import json
import re
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults
from tests.frames import record
from tests.nets import conv_attention, image


@pytest.fixture
def folder(dense: Path) -> Path:
    """The dense model, with three scenes of two frames."""
    draws = np.random.default_rng(1)
    frames = [
        {"camera": draws.normal(size=(4, 16)).astype(np.float32)} for _ in range(6)
    ]
    record(dense / "scenes", frames, (0, 2, 4))
    return dense


def ranges(command: Command, folder: Path, name: str, *words: str | Path) -> object:
    done = command(
        *("calibrate", folder / "dense.onnx", *words),
        *("--map", folder / "map.toml", "-o", folder / name),
    )
    assert done == 0
    return json.loads((folder / name).read_text()) if name.endswith("json") else None


@pytest.mark.parametrize("method", ["max-min", "mse"])
def test_saved_ranges_make_the_file_that_frames_make(
    command: Command, folder: Path, method: str
) -> None:
    ranges(command, folder, "r.json", folder / "scenes", "--method", method)
    for name, source in (("a", "--ranges"), ("b", "--frames")):
        where = folder / ("r.json" if source == "--ranges" else "scenes")
        done = command(
            *("compress", folder / "dense.onnx", "--scheme", "prediction"),
            *("--method", method, "--measure-frames", 0),
            *(source, where, "--map", folder / "map.toml"),
            *("-o", folder / f"{name}.onnx"),
        )
        assert done == 0

    one, other = (graph.load(folder / f"{name}.onnx") for name in "ab")
    assert [node.op_type for node in one.graph].count("QuantizeLinear") > 0
    assert graph.digest(one) == graph.digest(other)


def test_merged_shards_give_the_ranges_of_one_run(
    command: Command, folder: Path
) -> None:
    how = ("--method", "mse")
    whole = ranges(command, folder, "whole.json", folder / "scenes", *how)
    for part in ("1/2", "2/2"):
        name = f"shard{part[0]}.npz"
        ranges(command, folder, name, folder / "scenes", *how, "--shard", part)
    shards = ("--merge", folder / "shard1.npz", "--merge", folder / "shard2.npz")

    assert ranges(command, folder, "merged.json", *shards, *how) == whole


def shard(command: Command, folder: Path, part: str, *how: str) -> tuple[str, Path]:
    name = f"{part.replace('/', '-')}{''.join(how)}.npz"
    ranges(command, folder, name, folder / "scenes", "--shard", part, *how)
    return "--merge", folder / name


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (["1/3"], "shard 2 of 3 is missing, and 1 more"),
        (["1/3", "3/3"], "shard 2 of 3 is missing, and 0 more"),
        (["1/2", "3/3"], "shard 3 of 3, shard 1 of 2"),
        (["1/2 -n 4", "2/2 -n 6"], r"1 and 2 are of different draws \(4 and 6 frames"),
        (["1/2 -n 4", "2/2 -n 4 --seed 1"], "are of different draws"),
        (["1/2", "2/2", "2/2"], "frame 4 is in two of the shards"),
    ],
)
def test_shards_that_are_no_whole_are_one_line(
    command: Command,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    parts: list[str],
    message: str,
) -> None:
    words = [word for part in parts for word in shard(command, folder, *part.split())]
    capsys.readouterr()

    place = ("--map", folder / "map.toml", "-o", folder / "r.json")
    assert command("calibrate", folder / "dense.onnx", *words, *place) == 1

    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(message, error)
    assert not (folder / "r.json").exists()


def test_another_tools_cache_comes_and_goes(command: Command, folder: Path) -> None:
    cache, table = folder / "trt.cache", folder / "table"
    ours = ranges(
        command, folder, "r.json", folder / "scenes",
        "--tensorrt-cache", cache, "--onnxruntime-table", table,
    )  # fmt: skip
    assert isinstance(ours, dict)

    for foreign in (cache, table / "calibration.cache"):
        back = ranges(command, folder, "back.json", "--import", foreign)
        assert isinstance(back, dict)
        assert back["method"] == "imported"
        for name, (low, high) in ours["tensors"].items():
            reach = max(-low, high)
            assert back["tensors"][name] == pytest.approx((-reach, reach))


def test_fewer_frames_are_drawn_by_seed(command: Command, folder: Path) -> None:
    found = [
        ranges(command, folder, "r.json", folder / "scenes", "-n", "2", "--seed", seed)
        for seed in ("0", "0", "1", "2", "3")
    ]

    assert found[0] == found[1]
    assert any(each != found[0] for each in found[2:])


@pytest.mark.parametrize("shard", [(), ("--shard", "1/2")])
def test_programs_get_json(
    command: Command,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    shard: tuple[str, ...],
) -> None:
    words = ("calibrate", folder / "dense.onnx", folder / "scenes", *shard)
    place = ("--map", folder / "map.toml", "-o", folder / "r.npz", "--json")

    assert command(*words, *place) == 0

    assert faults("calibrate", strict(capsys.readouterr().out)) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "ranges are never made up"),
        (["scenes", "--import", "x"], "one of the three"),
        (["nowhere"], "nowhere: no such folder"),
        (["--import", "nowhere"], "no such calibration cache"),
        (["--merge", "nowhere"], "no such statistics"),
        (["scenes", "--shard", "half"], "write 2/4"),
        (["scenes", "--shard", "4/4"], "3 scenes cannot be shared by 4"),
        (["scenes", "--shard", "1/2", "--tensorrt-cache", "c"], "no ranges yet"),
        (["scenes", "--shard", "1/2", "--onnxruntime-table", "t"], "no ranges yet"),
        (
            ["scenes", "--method", "fp8"],
            "no calibration method 'fp8'; there",
        ),
        (["scenes", "-n", "0"], "at least 1 is needed"),
        (["scenes", "-r", "nothing"], "no recipe nothing"),
    ],
)
def test_what_cannot_be_calibrated_is_one_line(
    command: Command,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    places = [folder / w if w in ("scenes", "nowhere") else w for w in words]
    done = command(
        *("calibrate", folder / "dense.onnx", *places),
        *("--map", folder / "map.toml", "-o", folder / "r.json"),
    )

    assert done == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(message, error)
    assert not (folder / "r.json").exists()


def test_shards_of_another_model_and_quantized_graphs_are_refused(
    command: Command, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ranges(command, folder, "s.npz", folder / "scenes", "--shard", "1/1")
    compress = ("compress", folder / "dense.onnx", "--scheme", "full", "--frames")
    map_ = ("--map", folder / "map.toml")
    command(*compress, folder / "scenes", *map_, "-o", folder / "int8.onnx")
    again = ("calibrate", folder / "int8.onnx", folder / "scenes", *map_)

    assert command(*again, "-o", folder / "r.json") == 1
    assert "quantized already" in capsys.readouterr().err
    with_other = ("-r", "exact", "--merge", folder / "s.npz", "-o", folder / "r.json")
    model = graph.load(folder / "dense.onnx")
    model.graph[1].name = "/plan_head/Other"
    graph.save(model, folder / "other.onnx")
    assert command("calibrate", folder / "other.onnx", *with_other, *map_) == 1
    assert "stale: of graph" in capsys.readouterr().err


def test_a_graph_that_is_lowered_takes_saved_ranges(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph.save(conv_attention(), tmp_path / "m.onnx")
    frames = record(tmp_path / "frames", [image(seed) for seed in range(2)], (0,))
    (tmp_path / "map.toml").write_text(
        '[modules.backbone]\nrole = "feature"\npatterns = ["backbone"]\n'
        '[modules.head]\nrole = "prediction"\npatterns = ["head"]\n'
    )
    (tmp_path / "lower.toml").write_text('[[pass]]\nname = "lower-int8"\n')
    place, model = ("--map", tmp_path / "map.toml"), tmp_path / "int8.onnx"
    made = ("--scheme", "full", "--frames", frames, *place, "-o", model)
    assert command("compress", tmp_path / "m.onnx", *made) == 0

    saved, how = tmp_path / "r.json", ("-r", tmp_path / "lower.toml", *place)
    assert command("calibrate", model, frames, *how, "-o", saved) == 0
    for name, source in (("a", ("--ranges", saved)), ("b", ("--frames", frames))):
        done = command(
            *("compress", model, *how, *source, "--verify-frames", "0"),
            *("-o", tmp_path / f"{name}.onnx"),
        )
        assert done == 0

    one, other = (graph.load(tmp_path / f"{name}.onnx") for name in "ab")
    assert graph.digest(one) == graph.digest(other)
    capsys.readouterr()
    words = ("--rules", "paper", "-o", tmp_path / "c.onnx")
    assert command("compress", model, *how, *words) == 1
    assert "--rules is for int8" in capsys.readouterr().err
