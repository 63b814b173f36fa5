from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.commands.plan import PreparedGraph
from me2e_compress.manager import recipe
from tests.support.nets import conv_attention


@pytest.mark.parametrize(
    ("passes", "method"),
    [
        ("fold-constants", "mse"),
        ("quantize-int8{rules=paper}", "max-min"),
        ("quantize-int8{method=percentile:99}", "percentile:99"),
    ],
)
def test_ranges_are_measured_as_the_recipe_reads_them(
    passes: str, method: str, tmp_path: Path
) -> None:
    path = tmp_path / "m.onnx"
    graph.save(conv_attention(), path)

    ready = PreparedGraph.of(path, graph.load(path), "whole", recipe.parse(passes))

    assert ready.method == method
    # what is prepared leaves the message of the file
    stored = ready.model.graph.initializers.values()
    assert {type(each.const_value) for each in stored} == {ir.Tensor}
