"""Files written one weight at a time: the bytes that onnx.save writes."""

from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress.graph import files
from me2e_compress.graph.files import write_inline
from tests.nets import conv_attention

DTYPES = ("float32", "float64", "float16", "int64", "int32", "int8", "uint8", "bool")


def full() -> ir.Model:
    """Weights of every kind, metadata, functions."""
    model = conv_attention()
    model.metadata_props["me2e.plan"] = "ego"
    model.graph.doc_string = "a graph"
    random = np.random.default_rng(0)
    for index, dtype in enumerate(DTYPES):
        array = (random.normal(size=(3, 5 + index)) * 9).astype(dtype)
        value = ir.Value(name=f"of_{dtype}", const_value=ir.tensor(array))
        model.graph.register_initializer(value)
    words = ir.StringTensor([b"one", b"another"], shape=ir.Shape([2]))
    model.graph.register_initializer(ir.Value(name="words", const_value=words))
    for name, known in (("nameless", None), ("renamed", "before")):
        held = ir.tensor(np.arange(12, dtype=np.float32), name=known)
        value = ir.Value(name=name, const_value=held)
        model.graph.register_initializer(value)
        held.name = known
    noted = ir.tensor(random.normal(size=(4, 4)).astype("f"), doc_string="noted")
    model.graph.register_initializer(ir.Value(name="noted", const_value=noted))
    return model


@pytest.mark.parametrize("limit", [0, 100, 1 << 20])
@pytest.mark.parametrize("loaded", [False, True])
def test_the_bytes_are_those_of_onnx(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, limit: int, loaded: bool
) -> None:
    monkeypatch.setattr(files, "LARGE_BYTES", limit)
    model = full()
    if loaded:
        onnx.save(ir.to_proto(model), tmp_path / "first.onnx")
        model = ir.load(tmp_path / "first.onnx")

    before = {n: each.const_value for n, each in model.graph.initializers.items()}
    write_inline(model, tmp_path / "ours.onnx")
    for name, value in model.graph.initializers.items():
        assert value.const_value is before[name]  # it stays as it is

    onnx.save(ir.to_proto(model), tmp_path / "theirs.onnx")  # last: it names tensors
    theirs = (tmp_path / "theirs.onnx").read_bytes()
    assert (tmp_path / "ours.onnx").read_bytes() == theirs
