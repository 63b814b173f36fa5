import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import GraphError
from models.state_dict import read_state_dict
from models.tests.published_files import Tensors, lightning, mmcv, parallel, saved

TENSORS = {"a.weight": torch.arange(6.0).view(2, 3), "a.bias": torch.zeros(2)}


def same(found: Any, wanted: Tensors = TENSORS) -> bool:
    equal = (torch.equal(found[name], wanted[name]) for name in wanted)
    return found.keys() == wanted.keys() and all(equal)


@pytest.mark.parametrize("wrap", [dict, mmcv, lightning, parallel])
@pytest.mark.parametrize("zipped", [True, False])
def test_every_wrapper(
    tmp_path: Path, wrap: Callable[[Tensors], object], zipped: bool
) -> None:
    path = saved(tmp_path / "a.pth", wrap(TENSORS), zipped=zipped)

    assert same(read_state_dict(path).tensors)


def test_wrappers_in_wrappers(tmp_path: Path) -> None:
    inner = {f"module._orig_mod.{name}": each for name, each in TENSORS.items()}
    path = saved(tmp_path / "a.pth", lightning(inner))

    assert same(read_state_dict(path).tensors)


@pytest.mark.parametrize(
    ("wrap", "counts"),
    [(mmcv, (60, 211_080)), (lightning, (31, 9_000)), (dict, (None, None))],
)
def test_epoch_and_iteration_are_those_that_the_file_states(
    tmp_path: Path, wrap: Callable[[Tensors], object], counts: tuple[int | None, ...]
) -> None:
    found = read_state_dict(saved(tmp_path / "a.pth", wrap(TENSORS)))
    assert (found.epoch, found.iteration) == counts


def test_safetensors(tmp_path: Path) -> None:
    library = pytest.importorskip("safetensors.torch")
    path = tmp_path / "a.safetensors"
    library.save_file(parallel(TENSORS), path, metadata={"epoch": "60"})

    found = read_state_dict(path)

    assert same(found.tensors)
    assert found.epoch == 60


def test_broken_safetensors_are_one_line(tmp_path: Path) -> None:
    pytest.importorskip("safetensors")
    path = tmp_path / "a.safetensors"
    path.write_bytes(b"\x08\0\0\0\0\0\0\0{}")
    with pytest.raises(GraphError, match=r"a\.safetensors: .* cut or broken"):
        read_state_dict(path)


class Malicious:
    """Unpickled by Python itself, it would make a folder."""

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, ("made",)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickle_that_would_run_code_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zipped: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    held = {"state_dict": TENSORS, "hyper_parameters": Malicious()}
    path = saved(tmp_path / "a.pth", held, zipped=zipped)

    with pytest.raises(GraphError, match=r"it asks for posix.mkdir, which may run"):
        read_state_dict(path)

    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ([1, 2], "holds a list, not tensors by name"),
        ({"epoch": 3, "optimizer": {}}, "no state dict: it holds epoch, optimizer"),
        ({"state_dict": {"a": 1}}, "state_dict: 'a' is a int, not a tensor"),
        ({"state_dict": {}, "model": {}}, "it holds state_dict and model: keep one"),
        (TENSORS | {"module.a.bias": torch.ones(2)}, "it holds a.bias twice"),
    ],
)
def test_what_holds_no_tensors_by_name(
    tmp_path: Path, held: object, message: str
) -> None:
    path = saved(tmp_path / "a.pth", held)
    with pytest.raises(GraphError) as error:
        read_state_dict(path)
    assert str(error.value).startswith(f"{path}: not read as weights: ")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("name", "words"), [("a.pth", r"a\.pth: No such file"), ("", "it is a folder")]
)
def test_what_is_no_file(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(GraphError, match=words):
        read_state_dict(tmp_path / name)


@settings(max_examples=60, deadline=None)
@given(zipped=st.booleans(), data=st.data())
def test_cut_or_altered_files_are_one_line_or_whole(
    tmp_path_factory: pytest.TempPathFactory, zipped: bool, data: st.DataObject
) -> None:
    path = saved(tmp_path_factory.getbasetemp() / "b.pth", TENSORS, zipped=zipped)
    whole = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at] = data.draw(st.integers(0, 255))
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole)))])
    said = ""
    try:
        read_state_dict(path)
    except GraphError as error:
        said = str(error)
    assert "\n" not in said
