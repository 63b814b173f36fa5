"""The schemes that a search on the road chooses among."""

from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.errors import RecipeError
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager import recipe
from me2e_compress.study.on_road.grid import GridModules, GridPoint
from me2e_compress.zoo.shipped import shipped

DRIVER = GridModules(
    ("backbone", "neck"), ("track", "map", "occ", "planner"), ("planner",)
)


def test_the_shipped_drivers_planner_stays() -> None:
    modules = GridModules.of(graph.load(shipped("highway")), ModuleMap.load("highway"))

    assert modules.losable == ("track", "map", "motion", "occ")
    assert modules.needed == ("planner",)
    assert len(modules.grid(None, None, 1)) == 4 * 5
    assert len(modules.grid(None, None, 2)) == 4 * 11


def test_a_group_shares_a_choice_and_what_is_gone_is_not_int8() -> None:
    found = DRIVER.grid("backbone+neck,occ", "occ", 1)

    assert [each.name for each in found] == [
        "exact",
        "int8-occ",
        "int8-backbone+neck",
        "int8-backbone+neck+occ",
        "without-occ",
        "int8-backbone+neck_without-occ",
    ]


@pytest.mark.parametrize(
    ("groups", "ablate", "message"),
    [
        (
            "radar",
            None,
            "--modules radar: no such module in the graph; .* backbone",
        ),
        ("map,map", None, "--modules: map stands there twice"),
        (None, "radar", "--ablate radar: no such module"),
        (None, "planner", "--ablate planner: .*cannot do without.* track, map, occ$"),
        (None, "backbone", "--ablate backbone: the stack cannot do without"),
    ],
)
def test_modules_that_cannot_be_chosen(
    groups: str | None, ablate: str | None, message: str
) -> None:
    with pytest.raises(RecipeError, match=message):
        DRIVER.grid(groups, ablate, 1)


def test_the_recipe_of_a_point_is_read_back(tmp_path: Path) -> None:
    point = GridPoint(("backbone",), ("map", "occ"))
    passes = point.passes("safe", "onnxruntime", {"batch": 1, "0 x": 2})

    assert [each.name for each in passes if not each.exact] == [
        "ablate-modules",
        "quantize-int8",
    ]
    assert passes[3].name == "ablate-modules"
    (tmp_path / "r.toml").write_text(recipe.to_toml(passes))
    assert recipe.load(tmp_path / "r.toml") == passes
