import json
import stat
from collections import Counter
from pathlib import Path

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.simulator.routes import (
    SCENARIO_ABILITIES,
    SHIPPED,
    Route,
    digest_of,
    load_routes,
    pick_routes,
    save_routes,
)

ROUTES = tuple(
    Route(f"r{k}", "Accident", k, {"lanes": 2, "bend": "left"}) for k in range(6)
)


def test_a_manifest_comes_back_as_it_was_written(tmp_path: Path) -> None:
    file = tmp_path / "routes.json"
    save_routes(ROUTES, file)

    assert load_routes(file) == ROUTES
    assert list(tmp_path.iterdir()) == [file]
    made = {"generator", "road", "road_version", "set_sha256"}
    own = {"id", "scenario", "ability", "seed", "parameters"}
    assert set(json.loads(file.read_text())[0]) == made | own
    # it may be read by others
    (tmp_path / "plain").touch()
    plain = (tmp_path / "plain").stat().st_mode
    assert stat.S_IMODE(file.stat().st_mode) == stat.S_IMODE(plain)


def test_220_routes_ship_five_of_each_type() -> None:
    routes = load_routes()

    assert len(routes) == len({route.seed for route in routes}) == 220
    assert Counter(route.scenario for route in routes) == dict.fromkeys(
        SCENARIO_ABILITIES, 5
    )
    assert all(route.parameters for route in routes)
    assert digest_of(routes) == json.loads(SHIPPED.read_text())[0]["set_sha256"]


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


def test_a_missing_file_or_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="No such file"):
        load_routes(tmp_path / "none.json")
    with pytest.raises(EvaluationError, match="cannot be written"):
        save_routes(ROUTES, tmp_path / "none" / "routes.json")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"id": "a/b"}, "only letters, digits"),
        ({"id": ""}, "only letters, digits"),
        ({"scenario": "Nothing"}, "no scenario 'Nothing'; there are Accident"),
    ],
)
def test_an_impossible_route_is_refused(given: dict[str, str], words: str) -> None:
    fields = {"id": "a", "scenario": "Accident", **given}

    with pytest.raises(EvaluationError, match=words):
        Route(fields["id"], fields["scenario"], 0)


def test_picking_all_some_or_named_routes() -> None:
    assert pick_routes(ROUTES, "all") == ROUTES
    assert [route.id for route in pick_routes(ROUTES, "3")] == ["r0", "r2", "r4"]
    assert [route.id for route in pick_routes(ROUTES, "r5, r1")] == ["r5", "r1"]


@pytest.mark.parametrize(
    ("which", "words"),
    [
        ("0", "0 routes were asked for; there are 6"),
        ("7", "7 routes were asked for; there are 6"),
        ("r1, R5", "no route 'R5'; there are 6, for example r5"),
        ("r1,zz", "no route 'zz'; there are 6, for example r"),
    ],
)
def test_picking_what_is_not_there(which: str, words: str) -> None:
    with pytest.raises(EvaluationError, match=words):
        pick_routes(ROUTES, which)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('"lanes": 2', '"lanes": 3'), "changed after its routes were admitted"),
        (('"set_sha256": "', '"set_sha256": "0'), "changed after its routes"),
        (('"seed": 1, ', '"seed": 8, '), "changed after its routes were admitted"),
        (('"road_version": 1', '"road_version": 0'), "is of version 0 of the generato"),
        (('"road_version": 1, ', ""), "is of version None of the generator"),
    ],
)
def test_a_set_that_was_edited_or_is_of_the_first_road_is_refused(
    tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    file = tmp_path / "routes.json"
    save_routes(ROUTES[:2], file)
    text = file.read_text().replace("}\n]", "}]").replace(*change)
    file.write_text(text)

    with pytest.raises(EvaluationError) as caught:
        load_routes(file)

    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
