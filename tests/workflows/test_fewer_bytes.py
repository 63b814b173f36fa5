"""``--smaller``: bytes before nodes."""

from pathlib import Path

import numpy as np
import onnx
import pytest

from me2e_compress.workflows.compress import CompressOptions, compress

TABLE = """<ir_version: 8, opset_import: ["" : 17]>
table (float[16,64] x) => (float[16,64] y)
    <float[16,1] column = {COLUMN}, float[1,64] row = {ROW}>
{ outer = Mul(column, row)  bent = Relu(outer)  y = Add(x, bent) }"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    random, text = np.random.default_rng(0), TABLE
    for name, count in (("COLUMN", 16), ("ROW", 64)):
        numbers = ", ".join(map(str, random.normal(size=count)))
        text = text.replace(name, numbers)
    path = tmp_path / "model.onnx"
    onnx.save(onnx.parser.parse_model(text), path)
    return path


def test_no_table_is_written_out_where_bytes_come_first(model: Path) -> None:
    default, smaller = model.with_name("default.onnx"), model.with_name("smaller.onnx")
    for out in (default, smaller):
        options = CompressOptions(smaller=out is smaller)
        compress(model, out, "exact", options=options)
    table = 16 * 64 * 4
    assert default.stat().st_size > table > smaller.stat().st_size
