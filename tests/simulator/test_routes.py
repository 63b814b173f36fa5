import json
import stat
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.errors import EvaluationError
from me2e_compress.simulator.routes import (
    SETS,
    SHIPPED,
    Route,
    digest_of,
    load_routes,
    pick_routes,
    save_routes,
)
from me2e_compress.simulator.scenarios.catalogue import SCENARIO_ABILITIES

ROUTES = tuple(
    Route(f"r{k}", "Accident", "Overtaking", k, {"lanes": 2, "bend": "left"})
    for k in range(6)
)


def test_a_manifest_comes_back_as_it_was_written(tmp_path: Path) -> None:
    file = tmp_path / "routes.json"
    save_routes(ROUTES, file)

    assert load_routes(file) == ROUTES
    assert list(tmp_path.iterdir()) == [file]
    assert set(json.loads(file.read_text())[0]) == {
        "generator",
        "id",
        "scenario",
        "ability",
        "seed",
        "parameters",
    }


def test_220_routes_ship_five_of_each_type() -> None:
    routes = load_routes()

    assert len(routes) == len({route.seed for route in routes}) == 220
    assert Counter(route.scenario for route in routes) == dict.fromkeys(
        SCENARIO_ABILITIES, 5
    )
    assert all(route.parameters for route in routes)
    assert SHIPPED.suffix == ".json"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "Invalid JSON"),
        ("{}", "the file: Input should be a valid array"),
        ('[{"id": "a"}]', "0.scenario: Field required"),
        (
            '[{"id": "a", "scenario": "Accident", "ability": "Overtaking", '
            '"seed": "x", "parameters": {}}]',
            "0.seed: Input should be a valid integer",
        ),
    ],
)
def test_a_file_that_is_no_manifest_is_named(
    tmp_path: Path, text: str, words: str
) -> None:
    file = tmp_path / "routes.json"
    file.write_text(text)

    with pytest.raises(EvaluationError) as caught:
        load_routes(file)

    assert str(file) in str(caught.value)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_id_must_be_unique(tmp_path: Path) -> None:
    file = tmp_path / "routes.json"
    save_routes([ROUTES[0], ROUTES[1], ROUTES[0]], file)

    with pytest.raises(EvaluationError, match="routes 0 and 2 share the id r0"):
        load_routes(file)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="No such file"):
        load_routes(tmp_path / "none.json")


def test_a_folder_that_cannot_be_written_leaves_the_old_file(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="cannot be written"):
        save_routes(ROUTES, tmp_path / "none" / "routes.json")


def test_the_file_may_be_read_by_others(tmp_path: Path) -> None:
    file = tmp_path / "routes.json"
    save_routes(ROUTES, file)

    (tmp_path / "plain").touch()
    plain = (tmp_path / "plain").stat().st_mode
    assert stat.S_IMODE(file.stat().st_mode) == stat.S_IMODE(plain)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"id": "a/b"}, "only letters, digits"),
        ({"id": ""}, "only letters, digits"),
        ({"scenario": "Nothing"}, "no scenario 'Nothing'; there are Accident"),
        ({"ability": "Merging"}, "Accident tests Overtaking, not 'Merging'"),
    ],
)
def test_an_impossible_route_is_refused(given: dict[str, str], words: str) -> None:
    fields = {"id": "a", "scenario": "Accident", "ability": "Overtaking", **given}

    with pytest.raises(EvaluationError, match=words):
        Route(fields["id"], fields["scenario"], fields["ability"], 0)


def test_picking_all_some_or_named_routes() -> None:
    assert pick_routes(ROUTES, "all") == ROUTES
    assert [route.id for route in pick_routes(ROUTES, "3")] == ["r0", "r2", "r4"]
    assert [route.id for route in pick_routes(ROUTES, "r5, r1")] == ["r5", "r1"]


@pytest.mark.parametrize(
    ("which", "words"),
    [
        ("0", "0 routes were asked for; there are 6"),
        ("7", "7 routes were asked for; there are 6"),
        ("r1,zz", "no route 'zz'; there are 6, for example r0"),
    ],
)
def test_picking_what_is_not_there(which: str, words: str) -> None:
    with pytest.raises(EvaluationError, match=words):
        pick_routes(ROUTES, which)


SECOND = tuple(replace(route, road=2) for route in ROUTES[:2])


def test_a_set_of_the_second_road_says_so_and_comes_back(tmp_path: Path) -> None:
    file = tmp_path / "routes.json"
    save_routes(SECOND, file)

    assert load_routes(file) == load_routes(file, road=2) == SECOND
    records = json.loads(file.read_text())
    assert [record["road"] for record in records] == [2, 2]
    assert records[0]["set_sha256"] == digest_of(SECOND)


def test_the_first_road_is_written_and_fingerprinted_as_ever(tmp_path: Path) -> None:
    save_routes(load_routes(), tmp_path / "again.json")

    assert "road" not in (tmp_path / "again.json").read_text()
    assert digest_of(load_routes()).startswith("6018b3c6e79521d8")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('"lanes": 2', '"lanes": 3'), "changed after its routes were admitted"),
        (('"set_sha256": "', '"set_sha256": "0'), "changed after its routes"),
        (('"seed": 1, ', '"seed": 8, '), "changed after its routes were admitted"),
        (('"road_version": 1', '"road_version": 0'), "is of version 0 of the second"),
        (('"road_version": 1, ', ""), "is of version None of the second road's"),
        ((', "road": 2}]', "}]"), "r1 lies on road 1, r0 on road 2"),
        (('"road": 2', '"road": 3'), "road 3: there are 1 and 2"),
    ],
)
def test_a_set_of_the_second_road_that_was_edited_is_refused(
    tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    file = tmp_path / "routes.json"
    save_routes(SECOND, file)
    text = file.read_text().replace("}\n]", "}]").replace(*change)
    file.write_text(text)

    with pytest.raises(EvaluationError) as caught:
        load_routes(file)

    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_routes_of_the_second_road_ship_five_of_each_type() -> None:
    routes = load_routes(SETS[2], road=2)

    assert len({route.seed for route in routes}) == len(routes) == 220
    assert set(Counter(e.scenario for e in routes).values()) == {5}
    assert not {e.id for e in routes} & {e.id for e in load_routes()}
    assert all(route.parameters for route in routes)


def test_a_set_of_the_other_road_is_refused(tmp_path: Path) -> None:
    save_routes(SECOND, tmp_path / "new.json")

    with pytest.raises(EvaluationError, match="lie on road 1; road 2 was asked for"):
        load_routes(SHIPPED, road=2)
    with pytest.raises(EvaluationError, match="lie on road 2; road 1 was asked for"):
        load_routes(tmp_path / "new.json", road=1)
