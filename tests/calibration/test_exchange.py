import dataclasses
import struct
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnxruntime.quantization.CalTableFlatBuffers.TrtTable import TrtTable

from me2e_compress.calibration.exchange import (
    read_cache,
    taken_from,
    write_onnxruntime_table,
    write_tensorrt_cache,
)
from me2e_compress.calibration.observers import scale_of
from me2e_compress.calibration.ranges import IMPORTED, Ranges
from me2e_compress.errors import FramesError, RecipeError
from me2e_compress.graph import digest, provenance
from me2e_compress.graph.provenance import Provenance
from tests.profiles import scaled

NAMES = ("/head/MatMul output", "a: b", "image")


def ranges(method: str = "max-min") -> Ranges:
    ends = {NAMES[0]: (-3.5, 1.25), NAMES[1]: (0.0, 7.0), NAMES[2]: (-1e-3, 0.0)}
    return Ranges(ends, method, 4, "digest", "frames")


@pytest.mark.parametrize(
    ("method", "head"),
    [
        ("max-min", "TRT-101000-MinMaxCalibration"),
        ("mse", "TRT-101000-EntropyCalibration2"),
    ],
)
def test_the_cache_is_as_tensorrt_writes_it_and_goes_out_as_it_came_in(
    tmp_path: Path, method: str, head: str
) -> None:
    write_tensorrt_cache(ranges(method), tmp_path / "c")
    first, *lines = (tmp_path / "c").read_text().splitlines()

    assert first == head
    assert lines[0] == f"{NAMES[0]}: {struct.pack('>f', 3.5 / 127).hex()}"
    read_cache(tmp_path / "c").save(tmp_path / "r.json")
    write_tensorrt_cache(Ranges.load(tmp_path / "r.json"), tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "c").read_bytes()


@settings(max_examples=scaled(20))
@given(reach=st.floats(1e-30, 1e30))
def test_scales_survive_the_way_through_a_cache(
    tmp_path_factory: pytest.TempPathFactory, reach: float
) -> None:
    path = tmp_path_factory.mktemp("cache") / "c"
    write_tensorrt_cache(Ranges({"t": (0, reach)}, "mse", 1, "m", "f"), path)

    found = read_cache(path)

    assert scale_of(*found.tensors["t"]) == scale_of(0, reach)


def test_the_table_of_onnxruntime_holds_the_magnitudes(tmp_path: Path) -> None:
    write_onnxruntime_table(ranges(), tmp_path / "table")
    content = (tmp_path / "table" / "calibration.flatbuffers").read_bytes()

    table = TrtTable.GetRootAsTrtTable(content, 0)
    held = {}
    for at in range(table.DictLength()):
        entry = table.Dict(at)
        assert entry is not None
        held[(entry.Key() or b"").decode()] = float(entry.Value() or b"nan")
    assert held == pytest.approx(dict(zip(NAMES, (3.5, 7, 1e-3), strict=True)))
    found = read_cache(tmp_path / "table" / "calibration.cache")
    assert found.tensors[NAMES[0]] == (-3.5, 3.5)
    assert [each.name for each in (tmp_path / "table").iterdir() if each.is_dir()] == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("TRT-8501-X\nimage: zz", "line 2 is not a name and a number: 'image: zz'"),
        ("TRT-8501-X\nimage: 3c0a", "line 2 is not a name and a number"),
        ("TRT-8501-X\nimage: 7fc00000", "line 2 is not a range"),
        ("TRT-8501-X\na: 3c0a0000\na: 3d0a0000", "line 3 names a again"),
        ("image", "line 1 is not a name"),
        ("image -2", "line 1 is not a range"),
        ("image inf", "line 1 is not a range"),
        ("image 1e39", "line 1 is not a range"),
        ("", "a calibration cache without a tensor"),
        ("TRT-8501-X\n", "a calibration cache without a tensor"),
    ],
)
def test_a_cache_that_does_not_fit_is_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "c"
    with pytest.raises(FramesError, match="no such calibration cache"):
        read_cache(path)
    path.write_text(text)

    with pytest.raises(FramesError, match=message):
        read_cache(path)


def test_imported_ranges_fit_any_method_but_one_graph(tmp_path: Path) -> None:
    write_tensorrt_cache(ranges(), tmp_path / "c")
    found = dataclasses.replace(read_cache(tmp_path / "c"), model="digest")

    found.check(model="digest", tensors=NAMES, method="percentile", source="others")
    found.check(model="digest", tensors=NAMES, method=found.method)
    with pytest.raises(FramesError, match="of graph digest, not elsewhere"):
        found.check(model="elsewhere", tensors=NAMES, method="percentile")
    with pytest.raises(RecipeError, match="no calibration method 'fp8'"):
        found.check(model="digest", tensors=NAMES, method="fp8")
    with pytest.raises(RecipeError, match="no calibration method 'imported'"):
        ranges().check(model="digest", tensors=NAMES, method="imported")
    assert np.isfinite(list(found.tensors.values())).all()


def model(*origins: str) -> ir.Model:
    """Read a graph whose first node stands for some nodes of a source file."""
    read = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]> m (float[1,4] x) => (float[1,4] y)'
        '{ ["/c"] c = Abs(x) ["/r"] r = Relu(c) ["/y"] y = Exp(r) }'
    )
    provenance.stamp(read.graph[0], Provenance("head", origins))
    return read


def cache(*names: str) -> Ranges:
    return Ranges(dict.fromkeys(names, (-2.0, 2.0)), IMPORTED, 0, "", "")


def test_tensors_are_taken_from_a_cache_by_their_names() -> None:
    found = taken_from(cache("x", "c", "other"), Path("c"), model("/c"), "xcr")

    assert found.tensors == {"x": (-2.0, 2.0), "c": (-2.0, 2.0)}
    assert found.model == digest(model("/c"))
    merged = model("/conv", "/norm")  # whose name is not trusted
    assert list(taken_from(cache("x", "c"), Path("c"), merged, "xc").tensors) == ["x"]


@pytest.mark.parametrize("names", [("n1",), ("c", "n1", "n2")])
def test_a_cache_with_less_than_half_is_of_another_graph(
    names: tuple[str, ...],
) -> None:
    message = rf"c: a cache of another graph: it lacks \w and . more of 3 .*{names[0]}"
    with pytest.raises(FramesError, match=message):
        taken_from(cache(*names), Path("c"), model("/c"), "xcr")
