"""A graph that no protobuf can hold; 5 GB of disk and half a minute."""

import os
import resource
from pathlib import Path

import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager
from me2e_compress.passes import Context
from me2e_compress.passes.eliminate_redundant import EliminateRedundant

ROWS, COLUMNS = 600_000, 1024  # 2.46 GB of float32


def resident_mb() -> float:
    """Memory of this process that is its own, not mapped from files."""
    text = Path("/proc/self/status").read_text()
    return int(text.split("RssAnon:")[1].split()[0]) / 1024


def written(folder: Path) -> Path:
    """Write x -> Identity -> Gather from a table whose data file is a hole."""
    text = (
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        f"m (int64[4] x, float[{ROWS},{COLUMNS}] table) => (float[4,{COLUMNS}] y)"
        " { i = Identity(x)\n y = Gather(table, i) }"
    )
    proto = onnx.parser.parse_model(text)
    del proto.graph.input[1]
    weight = proto.graph.initializer.add(name="table", data_type=onnx.TensorProto.FLOAT)
    weight.dims.extend((ROWS, COLUMNS))
    weight.data_location = onnx.TensorProto.EXTERNAL
    entries = {
        "location": "table.data",
        "offset": "0",
        "length": f"{ROWS * COLUMNS * 4}",
    }
    for key, value in entries.items():
        weight.external_data.add(key=key, value=value)
    with (folder / "table.data").open("wb") as file:
        os.truncate(file.fileno(), ROWS * COLUMNS * 4)
    onnx.save(proto, folder / "large.onnx")
    return folder / "large.onnx"


@pytest.mark.slow
def test_more_than_2_gb_is_mapped_passed_and_saved(tmp_path: Path) -> None:
    before = resident_mb()
    model = graph.load(written(tmp_path))
    manager = PassManager((EliminateRedundant(),), verify_frames=0)
    report = manager.run(model, Context(ModuleMap.whole()))
    graph.save(report.model, tmp_path / "small.onnx")
    assert resident_mb() - before < 300
    back = graph.load(tmp_path / "small.onnx")
    assert [node.op_type for node in back.graph] == ["Gather"]
    weight = back.graph.initializers["table"].const_value
    assert isinstance(weight, ir.ExternalTensor)
    assert weight.nbytes == ROWS * COLUMNS * 4
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    assert peak_gb < 6
