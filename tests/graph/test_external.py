"""External data: what is read, and what lies where nobody should read it."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.atomic import BYTES
from me2e_compress.base.errors import GraphError
from tests.graph.test_files import weighted


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with m.onnx and m.onnx.data; beside it an empty one."""
    (tmp_path / "home").mkdir()
    (tmp_path / "other").mkdir()
    graph.save(weighted(), tmp_path / "home" / "m.onnx", external=True)
    return tmp_path / "home"


def point(model: Path, location: str) -> None:
    """Say that the weights lie elsewhere."""
    proto = onnx.load(model, load_external_data=False)
    for entry in proto.graph.initializer[0].external_data:
        if entry.key == "location":
            entry.value = location
    model.write_bytes(proto.SerializeToString())


def absolute(home: Path) -> None:
    point(home / "m.onnx", str(home / "m.onnx.data"))


def above(home: Path) -> None:
    (home / "m.onnx.data").rename(home.parent / "other" / "w")
    point(home / "m.onnx", "../other/w")


def linked_file(home: Path) -> None:
    (home / "m.onnx.data").rename(home.parent / "other" / "w")
    (home / "m.onnx.data").symlink_to(home.parent / "other" / "w")


def linked_folder(home: Path) -> None:
    (home / "m.onnx.data").rename(home.parent / "other" / "w")
    (home / "sub").symlink_to(home.parent / "other")
    point(home / "m.onnx", "sub/w")


@pytest.mark.parametrize("escape", [absolute, above, linked_file, linked_folder])
def test_data_outside_the_model_s_folder_are_neither_read_nor_hashed(
    home: Path, escape: Callable[[Path], None]
) -> None:
    escape(home)
    for read in (graph.load, graph.sha256_of):
        with pytest.raises(GraphError, match=r"m\.onnx: the data of w lie at .*not re"):
            read(home / "m.onnx")


def holds_numbers(model: ir.Model) -> bool:
    one, other = (m.graph.initializers["w"].const_value for m in (model, weighted()))
    assert one is not None
    assert other is not None
    return np.array_equal(one.numpy(), other.numpy())


def test_links_within_the_folder_are_followed_and_a_hub_s_cache(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(home)
    model = graph.load(Path("m.onnx"))
    monkeypatch.chdir(home.parent)
    assert holds_numbers(model)  # the file is mapped by its whole path
    (home.parent / "linked").symlink_to(home)
    for name in ("m.onnx", "m.onnx.data"):
        (home.parent / "other" / name).symlink_to(home / name)
    assert holds_numbers(graph.load(home.parent / "linked" / "m.onnx"))
    assert holds_numbers(graph.load(home.parent / "other" / "m.onnx"))
    (home / "m.onnx.data").rename(home / "w")
    (home / "m.onnx.data").symlink_to("w")
    assert holds_numbers(graph.load(home / "m.onnx"))
    os.link(home / "w", home / "again")
    with pytest.raises(GraphError, match="2 hard links, which onnx refuses: copy it"):
        graph.load(home / "m.onnx")


def test_the_tensor_of_a_constant_may_lie_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = onnx.parser.parse_model(
        '<ir_version: 9, opset_import: ["" : 17]> m () => (float[3] y)'
        " { y = Constant<value = float[3] {1, 2, 3}>() }"
    )
    onnx.save(
        model,
        str(tmp_path / "m.onnx"),
        save_as_external_data=True,
        location="w",
        size_threshold=0,
        convert_attribute=True,
    )
    value = graph.load(tmp_path / "m.onnx").graph[0].attributes["value"]
    assert list(value.as_tensor().numpy()) == [1, 2, 3]
    assert not isinstance(value.as_tensor(), ir.ExternalTensor)


def test_the_bytes_of_a_model_are_those_of_every_file_of_weights(home: Path) -> None:
    (home / "m.onnx.data").rename(home / "w")
    point(home / "m.onnx", "w")
    model = (home / "m.onnx").stat().st_size
    assert graph.file_bytes(home / "m.onnx") == model + 64 * 8 * 4 + len(BYTES)
