"""The adapters of docs/adapter.md fit the graphs that it shows them with."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.inputs import ModelInputs
from me2e_compress.driving.adapter.recurrent import FirstValues
from me2e_compress.driving.onnx_policy import recurrent_of
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.runtime.session import DTYPES, Session
from tests.docs.pages import ROOT, Block, blocks
from tests.driving.observed import motion, observation
from tests.evaluators.highway.drivers import straight_on

PAGE = ROOT / "docs" / "adapter.md"
SHOWN = blocks(PAGE, "onnx", "toml")
TCP = (
    Block("onnx", "float[1,3,256,900] img, float[1,9] state, float[1,2] target_point"),
    Block("toml", adapter_file(Path("tcp")).read_text(encoding="utf-8")),
)
EXAMPLES = [*zip(SHOWN[::2], SHOWN[1::2], strict=True), TCP]


@pytest.mark.parametrize(("graph", "adapter"), EXAMPLES)
def test_a_graph_is_fed_by_the_adapter_beside_it(
    graph: Block, adapter: Block, tmp_path: Path
) -> None:
    assert (graph.language, adapter.language) == ("onnx", "toml")
    model = straight_on(
        tmp_path / "m.onnx",
        inputs=graph.text.strip(),
        outputs="float[1, 6, 2] plan, float[1, 3, 3] l2g_r_mat_out",
        body="plan = Identity (ahead) l2g_r_mat_out = Identity (turn_of)",
        initializers=f", float[1, 3, 3] turn_of = {{{'0, ' * 8} 1}}",
    )
    toml = tmp_path / "a.toml"
    toml.write_text(adapter.text)
    session = Session(model, threads=1)

    read = Adapter.load(toml)
    recurrent = recurrent_of(session, read)
    inputs = ModelInputs.of(session, read, recurrent)
    now = motion(0.0, 0.0, 0.0)
    pictures = np.zeros((6, *inputs.image_size, 3), np.uint8)
    found = inputs.feeds(observation(now, images=pictures))

    found |= FirstValues.of(session, read.recurrent, recurrent).at(found)
    found |= FirstValues.of(session, read.recurrent, recurrent).zeros
    for name, port in session.inputs.items():
        assert found[name].shape == port.shape
        assert found[name].dtype == DTYPES[port.type]
