import os
from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.atomic import BYTES
from me2e_compress.base.errors import GraphError
from me2e_compress.graph import files
from tests.support.nets import parsed, stored


def weighted(rows: int = 64) -> ir.Model:
    """x @ w with a weight that is worth a file of its own."""
    ports = f"(float[1,{rows}] x, float[{rows},8] w) => (float[1,8] y)"
    draws = np.random.default_rng(0).normal(size=(rows, 8)).astype(np.float32)
    return stored(parsed(f"m {ports} {{ y = MatMul(x, w) }}"), {"w": draws})


def test_a_saved_graph_loads_and_weights_stay_on_disk(tmp_path: Path) -> None:
    graph.save(weighted(), f"{tmp_path}/all.onnx")
    assert graph.digest(graph.load(f"{tmp_path}/all.onnx")) == graph.digest(weighted())
    assert [file.name for file in tmp_path.iterdir()] == ["all.onnx"]
    graph.save(weighted(), tmp_path / "m.onnx", external=True)
    back = graph.load(tmp_path / "m.onnx")
    assert isinstance(back.graph.initializers["w"].const_value, ir.ExternalTensor)
    assert (tmp_path / "m.onnx.data").stat().st_size == 64 * 8 * 4 + len(BYTES)
    graph.save(back, tmp_path / "n.onnx")
    assert (tmp_path / "n.onnx.data").exists()
    graph.save(back, tmp_path / "n.onnx", external=False)
    assert not (tmp_path / "n.onnx.data").exists()
    assert graph.digest(graph.load(tmp_path / "n.onnx")) == graph.digest(weighted())
    with pytest.raises(GraphError, match=r"m\.onnx\.data: holds the weights"):
        graph.save(back, tmp_path / "m.onnx")  # would lose what it reads


def test_a_failed_save_keeps_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.onnx"
    graph.save(weighted(), path)
    before = path.read_bytes()

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ir, "save", full)
    with pytest.raises(OSError, match="No space"):
        graph.save(weighted(32), path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["m.onnx"]


CUT = onnx.helper.make_model(
    onnx.helper.make_graph([], "g", [], []), producer_name="x" * 99
).SerializeToString()[:50]


@pytest.mark.parametrize(
    ("junk", "message"),
    [
        (None, "no such file"),
        (b"", "not an? .*ONNX"),
        (b"PK\x03\x04 a zip, not a graph", "not an? .*ONNX"),
        (bytes(range(256)) * 8, "not an? .*ONNX"),
        (b"hello\n" * 99, "not an? .*ONNX"),
        (CUT, "not an ONNX file, or cut short"),
    ],
    ids=["missing", "empty", "zip", "binary", "text", "truncated"],
)
def test_files_that_are_not_onnx(
    tmp_path: Path, junk: bytes | None, message: str
) -> None:
    if junk is not None:
        (tmp_path / "junk.onnx").write_bytes(junk)
    with pytest.raises(GraphError, match=rf"junk\.onnx: {message}"):
        graph.load(tmp_path / "junk.onnx")


def test_external_data_cut_short_or_missing_are_named(tmp_path: Path) -> None:
    graph.save(weighted(), tmp_path / "m.onnx", external=True)
    data = tmp_path / "m.onnx.data"
    data.write_bytes(data.read_bytes()[:100])
    with pytest.raises(GraphError, match=r"m\.onnx\.data is cut short: w ends"):
        graph.load(tmp_path / "m.onnx")
    data.unlink()
    with pytest.raises(GraphError, match=r"m\.onnx\.data is missing"):
        graph.load(tmp_path / "m.onnx")


def test_a_model_of_ir_version_3_is_raised_to_4(tmp_path: Path) -> None:
    proto = onnx.parser.parse_model(
        """
        <ir_version: 3, opset_import: ["" : 13]>
        old (float[2] x, float[2] w) => (float[2] y) { y = Add(x, w) }
        """
    )
    proto.graph.initializer.append(
        onnx.numpy_helper.from_array(np.ones(2, np.float32), "w")
    )
    onnx.save(proto, tmp_path / "old.onnx")

    graph.save(graph.load(tmp_path / "old.onnx"), tmp_path / "new.onnx")

    onnx.checker.check_model(tmp_path / "new.onnx", full_check=True)
    saved = onnx.load(tmp_path / "new.onnx")
    assert saved.ir_version == 4
    assert [value.name for value in saved.graph.input] == ["x"]


def test_weights_and_model_are_replaced_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.onnx"
    graph.save(weighted(64), path, external=True)
    before = graph.digest(graph.load(path))
    replace, moved = os.replace, list[str]()

    def killed(source: Path, target: Path) -> None:
        if moved:
            raise KeyboardInterrupt
        moved.append(Path(target).name)
        replace(source, target)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        graph.save(weighted(128), path, external=True)
    monkeypatch.undo()
    assert moved == ["m.onnx.1.data"]
    assert graph.digest(graph.load(path)) == before

    graph.save(weighted(128), path, external=True)
    assert graph.digest(graph.load(path)) == graph.digest(weighted(128))
    names = sorted(file.name for file in tmp_path.iterdir())
    assert names == ["m.onnx", "m.onnx.1.data"]


@pytest.mark.parametrize("block", [3, 8, 1 << 22])
def test_a_hash_covers_external_data_wherever_the_name_of_its_file_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    path = tmp_path / "m.onnx"
    graph.save(weighted(), path, external=True)
    before = graph.sha256_of(path)
    monkeypatch.setattr(files, "_BLOCK_BYTES", block)
    assert graph.sha256_of(path) == before

    data = path.with_name("m.onnx.data")
    data.write_bytes(bytes(data.stat().st_size))
    assert graph.sha256_of(path) != before
