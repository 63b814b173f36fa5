"""A folder of episodes: whole, resumable, the same bytes however it was made."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.evaluators.highway.driven_frames import seed_of
from me2e_compress.graph import sha256_of
from me2e_compress.simulator.routes import SCENARIO_ABILITIES, Route, load_routes
from models.driver.episodes import (
    Collection,
    collect,
    collecting,
    decode,
)
from models.driver.episodes import collection as room
from models.driver.errors import TrainingError
from tests.docs.pages import ROOT
from tests.evaluators.highway.drivers import straight_on

FEW = {name: SCENARIO_ABILITIES[name] for name in ("HighwayExit", "ControlLoss")}
WHAT = Collection(seed=3, variants=1, every=40, image_size=(16, 24))


def nobody(done: int, total: int) -> None:
    """Do not listen."""


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture
def two_types(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only two of the 44 types, in this process and those it starts."""
    monkeypatch.setattr(room, "SCENARIO_ABILITIES", FEW)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both of them; take copies."""
    made = tmp_path_factory.mktemp("collected") / "data"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "SCENARIO_ABILITIES", FEW)
        collect(made, WHAT, None, 1, nobody)
    return made


@pytest.fixture
def folder(tmp_path: Path, collected: Path, two_types: None) -> Path:
    return Path(shutil.copytree(collected, tmp_path / "data"))


def test_a_file_a_route_and_what_they_are(folder: Path) -> None:
    assert sorted(bytes_of(folder)) == [
        "ControlLoss_3_000.npz",
        "HighwayExit_3_000.npz",
        "dataset.json",
    ]
    with np.load(folder / "HighwayExit_3_000.npz") as episode:
        assert str(episode["scenario"]) == "HighwayExit"
        assert str(episode["route"]) == "HighwayExit_3_000"
        first = episode["jpeg"][: episode["jpeg_offsets"][1]]
        assert decode(first).shape == (6, 16, 24, 3)
    told = json.loads((folder / "dataset.json").read_bytes())
    assert told == {
        **{"format": 2, "seed": 3, "variants": 1, "every": 40, "noise": 1.0},
        **{"image_size": [16, 24], "expert_share": 1.0, "student": None},
        "scenarios": [],
    }


def test_workers_do_not_matter(folder: Path, tmp_path: Path) -> None:
    collect(tmp_path / "more", WHAT, None, 2, nobody)

    assert bytes_of(tmp_path / "more") == bytes_of(folder)


def test_only_what_is_missing_is_driven(folder: Path) -> None:
    whole, heard = bytes_of(folder), list[tuple[int, int]]()
    (folder / "HighwayExit_3_000.npz").unlink()
    kept = (folder / "ControlLoss_3_000.npz").stat().st_ino

    collect(folder, WHAT, None, 1, lambda *told: heard.append(told))

    assert heard == [(1, 2), (2, 2)]
    assert (folder / "ControlLoss_3_000.npz").stat().st_ino == kept
    assert bytes_of(folder) == whole


@pytest.mark.parametrize("change", [{"noise": 0.5}, {"seed": 4}, {"every": 2}])
def test_a_folder_of_another_collection_is_refused(
    folder: Path, change: dict[str, Any]
) -> None:
    (key,) = change

    with pytest.raises(TrainingError, match=f"another collection: its {key} is"):
        collect(folder, replace(WHAT, **change), None, 1, nobody)


def test_no_route_for_evaluation_is_trained_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    judged = Route("judged", "T_Junction", seed_of(3, "T_Junction", 0))
    monkeypatch.setattr(room, "load_routes", lambda: (*load_routes(), judged))

    with pytest.raises(TrainingError, match="seed 3 gives route judged"):
        collect(tmp_path, WHAT, None, 1, nobody)


def test_the_shipped_routes_are_such_proposals(monkeypatch: pytest.MonkeyPatch) -> None:
    shipped = load_routes()[0]
    monkeypatch.setattr(room, "seed_of", lambda *words: shipped.seed)

    with pytest.raises(TrainingError, match=f"gives route {shipped.id},"):
        room.tasks_of(WHAT)


def test_what_is_too_short_is_not_driven_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, two_types: None
) -> None:
    monkeypatch.setattr(collecting, "SHORTEST_US", 10**12)
    collect(tmp_path, WHAT, None, 1, nobody)
    heard = list[tuple[int, int]]()

    collect(tmp_path, WHAT, None, 1, lambda *told: heard.append(told))

    assert heard == [(2, 2)]
    assert "HighwayExit_3_000.skipped" in bytes_of(tmp_path)


def test_killed_it_leaves_whole_files_and_no_processes(tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(
        "from pathlib import Path\n"
        "from models.driver.episodes import Collection, collect\n"
        "if __name__ == '__main__':\n"
        "    what = Collection(3, 1, every=40, image_size=(16, 24))\n"
        "    collect(Path('data'), what, None, 2, lambda done, total: None)\n"
    )
    here = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.Popen([sys.executable, str(script)], cwd=tmp_path, env=here)
    data = tmp_path / "data"
    try:
        assert _soon(lambda: len(list(data.glob("*.npz"))) > 0)
        family = psutil.Process(run.pid).children(recursive=True)
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()

    _, alive = psutil.wait_procs(family, timeout=20)
    assert alive == []
    for path in data.glob("*.npz"):
        with np.load(path) as episode:
            assert len(episode["plan"]) == len(episode["jpeg_offsets"]) - 1


def _soon(happened: Callable[[], bool]) -> bool:
    until = time.monotonic() + 240
    while not happened() and time.monotonic() < until:
        time.sleep(0.1)
    return happened()


def taught(model: Path) -> Collection:
    return replace(WHAT, expert_share=0.5, student=sha256_of(model))


def test_the_student_must_be_that_of_the_collection(tmp_path: Path) -> None:
    model, other = (straight_on(tmp_path / name) for name in ("a.onnx", "b.onnx"))
    straight_on(other, metadata={"name": "other"})

    for student, words in (
        (other, r"b\.onnx: its sha256 is"),
        (None, r"student is \w{64}, none was given"),
    ):
        with pytest.raises(TrainingError, match=words):
            collect(tmp_path / "data", taught(model), student, 1, nobody)


def test_a_student_of_other_images_is_refused(tmp_path: Path) -> None:
    norm = {"input": "img", "mean": [0] * 3, "std": [1] * 3, "order": "rgb"}
    model = straight_on(
        tmp_path / "a.onnx",
        inputs="float[1, 6, 3, 32, 48] img",
        metadata={"me2e.image": json.dumps(norm)},
    )

    with pytest.raises(TrainingError, match=r"takes images of \(32, 48\), the coll"):
        collect(tmp_path / "data", taught(model), model, 1, nobody)


@pytest.mark.usefixtures("two_types")
def test_a_student_that_fails_is_an_error(tmp_path: Path) -> None:
    model = straight_on(
        tmp_path / "a.onnx",
        inputs="float[18] can_bus",
        body="""
            speed = Gather (can_bus, seven)
            beyond = Cast <to = 7> (speed)
            plan = Gather (ahead, beyond)""",
        initializers=", int64[1] seven = {7}",
    )

    with pytest.raises(TrainingError, match=r"route \w+_3_000: FramesError: "):
        collect(tmp_path / "data", taught(model), model, 1, nobody)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": -1}, "seed is -1, it must be at least 0"),
        ({"variants": 0}, "variants is 0, it must be at least 1"),
        ({"every": 0}, "every is 0"),
        ({"noise": float("nan")}, "noise is nan"),
        ({"expert_share": 1.5}, "expert_share is 1.5, it must be between 0 and 1"),
        ({"expert_share": 0.5}, "expert_share is 0.5 with no student"),
        ({"student": "0" * 64}, "expert_share is 1.0 with a student"),
    ],
)
def test_values_out_of_range(change: dict[str, Any], words: str) -> None:
    with pytest.raises(TrainingError, match=f"collection: {words}"):
        replace(WHAT, **change)


def test_no_workers_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="0 workers"):
        collect(tmp_path, WHAT, None, 0, nobody)


def test_no_jpeg_is_an_error() -> None:
    with pytest.raises(EvaluationError, match="a picture of 8 bytes is not a JPEG"):
        decode(np.zeros(8, np.uint8))
