import dataclasses
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import FramesError, RecipeError
from me2e_compress.calibration.exchange import pick_ranges, read_cache
from me2e_compress.calibration.observers import QUANT_MAX, scale_of
from me2e_compress.calibration.ranges import IMPORTED, Ranges
from me2e_compress.graph import digest, provenance
from me2e_compress.graph.provenance import Provenance
from tests.support.frames import tensorrt_cache
from tests.support.profiles import scaled

NAMES = ("/head/MatMul output", "a: b", "image")


def ranges() -> Ranges:
    ends = {NAMES[0]: (-3.5, 1.25), NAMES[1]: (0.0, 7.0), NAMES[2]: (-1e-3, 0.0)}
    return Ranges(ends, "max-min", 4, "digest", "frames")


@settings(max_examples=scaled(20))
@given(scale=st.floats(2.0**-100, 2.0**100, width=32))
def test_a_scale_of_tensorrt_is_read_to_the_bit(
    tmp_path_factory: pytest.TempPathFactory, scale: float
) -> None:
    path = tmp_path_factory.mktemp("cache") / "c"
    path.write_text(tensorrt_cache({NAMES[1]: (0.0, scale * QUANT_MAX)}))

    assert scale_of(*read_cache(path).tensors[NAMES[1]]) == np.float32(scale)


def test_the_table_of_onnxruntime_holds_magnitudes(tmp_path: Path) -> None:
    (tmp_path / "calibration.cache").write_text(f"{NAMES[0]} 3.5\n{NAMES[1]} 7.0\n")

    assert read_cache(tmp_path / "calibration.cache").tensors == {
        NAMES[0]: (-3.5, 3.5),
        NAMES[1]: (-7.0, 7.0),
    }


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
    (tmp_path / "c").write_text(tensorrt_cache(ranges().tensors))
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
    found = pick_ranges(cache("x", "c", "other"), Path("c"), model("/c"), "xcr")

    assert found.tensors == {"x": (-2.0, 2.0), "c": (-2.0, 2.0)}
    assert found.model == digest(model("/c"))
    merged = model("/conv", "/norm")  # whose name is not trusted
    assert list(pick_ranges(cache("x", "c"), Path("c"), merged, "xc").tensors) == ["x"]


@pytest.mark.parametrize("names", [("n1",), ("c", "n1", "n2")])
def test_a_cache_with_under_half_is_of_another_graph(names: tuple[str, ...]) -> None:
    message = rf"another graph: of 3 .* it lacks \w and . more; it has {names[0]}"
    with pytest.raises(FramesError, match=message):
        pick_ranges(cache(*names), Path("c"), model("/c"), "xcr")
