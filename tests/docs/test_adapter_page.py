"""The adapters of docs/adapter.md fit the graphs that it shows them with."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.inputs import ModelInputs
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.runtime.session import DTYPES, Session
from tests.docs.pages import ROOT, Block, blocks
from tests.driving.observed import motion, observation
from tests.evaluators.highway.drivers import straight_on

PAGE = ROOT / "docs" / "adapter.md"
SHOWN = blocks(PAGE, "onnx", "toml")
EXAMPLES = list(zip(SHOWN[::2], SHOWN[1::2], strict=True))


@pytest.mark.parametrize(("graph", "adapter"), EXAMPLES)
def test_a_graph_is_fed_by_the_adapter_beside_it(
    graph: Block, adapter: Block, tmp_path: Path
) -> None:
    assert (graph.language, adapter.language) == ("onnx", "toml")
    model = straight_on(tmp_path / "m.onnx", inputs=graph.text.strip())
    toml = tmp_path / "a.toml"
    toml.write_text(adapter.text)
    session = Session(model, threads=1)

    inputs = ModelInputs.of(session, Adapter.load(toml), session.recurrent)
    now = motion(0.0, 0.0, 0.0)
    pictures = np.zeros((6, *inputs.image_size, 3), np.uint8)
    found = inputs.feeds(observation(now, images=pictures))

    for name, port in session.inputs.items():
        assert found[name].shape == port.shape
        assert found[name].dtype == DTYPES[port.type]


def test_the_shipped_adapter_is_what_the_page_shows(tmp_path: Path) -> None:
    shown = tmp_path / "a.toml"
    shown.write_text(EXAMPLES[0][1].text)

    assert Adapter.load(shown) == Adapter.load(adapter_file(Path("tcp")))


def test_a_source_can_be_added_as_the_page_says() -> None:
    (block,) = blocks(PAGE, "python")
    exec(compile(block.text, "adapter.md", "exec"), {"__name__": "adapter_page"})
