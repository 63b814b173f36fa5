"""A scheme of a part of the graph needs a map that tells the parts apart."""

import pytest

from me2e_compress.errors import ModuleMapError
from me2e_compress.graph.modules import Module, ModuleMap
from me2e_compress.quantization.scheme import QuantScheme


@pytest.mark.parametrize("scheme", ["feature-ext", "prediction"])
def test_a_part_of_a_graph_without_parts_is_refused(scheme: str) -> None:
    with pytest.raises(ModuleMapError, match=f"{scheme} is of a part .* map whole"):
        QuantScheme.named(scheme, ModuleMap.whole())

    assert QuantScheme.named("full", ModuleMap.whole()).modules == ("model",)


@pytest.mark.parametrize("scheme", ["feature-ext", "prediction"])
def test_so_it_is_of_a_map_of_predictions_alone(scheme: str) -> None:
    heads = ModuleMap("heads", (Module("planner", "prediction", ("head",)),))

    with pytest.raises(ModuleMapError, match="no module of role feature"):
        QuantScheme.named(scheme, heads)
