"""The whole way in small: once through, killed, resumed, refused."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import psutil
import pytest

from me2e_compress.base.listener import Listener
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.simulator.routes import load_routes
from models.driver.checkpoint import TrainingCheckpoint
from models.driver.course import frames_in, run
from models.driver.curriculum import (
    FULL,
    SMALL,
    SMALL_LATENCY,
    Course,
    Round,
    Trial,
    held_out_files,
)
from models.driver.episodes.collection import Collection, tasks_of
from models.driver.errors import TrainingError
from models.driver.log import Log
from models.driver.network.stack import Highway
from models.driver.options import difference
from models.driver.process import Training
from models.tests.driver.made import arrays_of, write
from models.tests.driver.small import WORKERS

pytestmark = pytest.mark.xdist_group("small-course")

KEPT = ("last.pt", "log.jsonl")
"""Of a stage, in the repository."""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command comes to, never interrupted."""
    folder = tmp_path_factory.mktemp("course") / "driver"
    words = ("--small", "--workers", str(WORKERS), "-o")
    subprocess.run(
        [sys.executable, "-m", "models.driver.train", *words, folder],
        check=True,
        capture_output=True,
    )
    return folder


@pytest.mark.slow
def test_every_round_leaves_a_driver_and_a_log(small: Path) -> None:
    for number in range(2):
        policy = OnnxPolicy.open(small / f"round-{number}" / "driver.onnx")
        assert policy.image_size == (96, 160)
    rows = Log(small / "round-1" / "training-1" / "log.jsonl").rows()
    assert [row["what"] for row in rows] == ["losses", "closed_loop"]
    mean, low, high = rows[1]["driving_score_percent"]
    assert 0 <= low <= mean <= high <= 100
    assert (rows[1]["routes"], len(rows[1]["success_rate_percent"])) == (2, 3)
    files = list(small.glob("round-*/episodes/*.npz"))
    held_out = held_out_files(sorted(small.glob("round-0/episodes/*.npz")))
    assert rows[1]["learned_frames"] == frames_in(files) - frames_in(held_out)


@pytest.mark.slow
def test_the_student_drives_in_the_second_round(small: Path) -> None:
    told = [
        json.loads((small / f"round-{n}" / "episodes" / "dataset.json").read_bytes())
        for n in range(2)
    ]
    assert [each["student"] is None for each in told] == [True, False]
    assert told[1]["expert_share"] == SMALL.rounds[1].expert_share < 1


@pytest.mark.slow
def test_trial_routes_are_neither_learned_from_nor_judged_on(small: Path) -> None:
    tried = {
        (route.scenario, route.seed) for route in load_routes(small / "trial.json")
    }
    judged = {(route.scenario, route.seed) for route in load_routes()}
    learned = {
        (task.scenario, task.seed)
        for each in SMALL.rounds
        for task in tasks_of(
            Collection(each.seed, each.variants, scenarios=each.scenarios)
        )
    }
    assert len(tried) == SMALL.trial.routes
    assert not tried & (judged | learned)


@pytest.mark.slow
def test_weights_and_logs_are_enough_to_go_on(small: Path, tmp_path: Path) -> None:
    kept = ("course.json", "trial.json", *(f"training-0/{each}" for each in KEPT))
    for name in kept:
        source = Path(name) if name.endswith(".json") else Path("round-0", name)
        (tmp_path / source).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(small / source, tmp_path / source)

    run(SMALL, tmp_path, WORKERS, latency=SMALL_LATENCY)

    drivers = [place / "round-1" / "driver.onnx" for place in (tmp_path, small)]
    assert drivers[0].read_bytes() == drivers[1].read_bytes()


@pytest.mark.slow
def test_a_stage_at_its_end_keeps_no_state_of_learning(small: Path) -> None:
    ends = ("round-0/training-0", "round-1/training-1")
    for stage in (*ends, "round-1/training-0"):
        found = TrainingCheckpoint.load(small / stage / "last.pt")
        assert found.optimizer == found.model == {}
        names = Highway(SMALL.config).state_dict().keys() if stage in ends else ()
        assert found.mean.keys() == set(names)


@pytest.mark.slow
def test_a_finished_course_is_not_gone_again(small: Path) -> None:
    def times() -> dict[str, int]:
        files = sorted(small.rglob("*"))
        return {
            str(file): file.stat().st_mtime_ns
            for file in files
            if file.is_file() and file.name != "log.jsonl"
        }

    before, news = times(), list[tuple[str, int, int, str]]()
    listener = Listener(lambda *told: news.append(told))
    rounds = run(SMALL, small, WORKERS, listener, SMALL_LATENCY)
    assert [each.driver.parent.name for each in rounds] == ["round-0", "round-1"]
    assert times() == before
    told = [(done, total) for what, done, total, _ in news if "training" not in what]
    assert all(done == total for done, total in told)


@pytest.mark.slow
def test_another_course_is_refused_there(small: Path) -> None:
    other = replace(SMALL, trial=replace(SMALL.trial, seed=901))
    words = "holds another course: its trial.seed is 900, this one's 901; choose"
    with pytest.raises(TrainingError, match=words):
        run(other, small, WORKERS)


def start(folder: Path, rounds: int) -> subprocess.Popen[bytes]:
    words = [
        sys.executable,
        "-m",
        "models.tests.driver.small",
        str(folder),
        str(rounds),
    ]
    return subprocess.Popen(words)


def kill_when(folder: Path, rounds: int, happened: Callable[[], bool]) -> None:
    """Begin, wait until it happened, kill; nobody may be left behind."""
    process = start(folder, rounds)
    until = time.monotonic() + 300
    try:
        while not happened() and process.poll() is None and time.monotonic() < until:
            time.sleep(0.005)
        family = psutil.Process(process.pid).children(recursive=True)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert process.returncode == -signal.SIGKILL
    assert psutil.wait_procs(family, timeout=30)[1] == []


def kill_while_driving(folder: Path, rounds: int, which: int) -> None:
    place = folder / f"round-{which}" / "episodes"
    total = len(SMALL.rounds[which].scenarios)

    def driven() -> int:
        return sum(file.name[0] != "." for file in place.glob("*.npz"))

    def begun() -> bool:
        return (place / "dataset.json").exists() and driven() >= total - 2

    kill_when(folder, rounds, begun)
    assert driven() < total


def kill_while_training(folder: Path, rounds: int, which: int) -> None:
    last = folder / f"round-{which}" / "training-0" / "last.pt"
    kill_when(folder, rounds, last.exists)
    assert TrainingCheckpoint.load(last).step < SMALL.rounds[which].trainings[0].steps


def finish(folder: Path, rounds: int) -> None:
    assert start(folder, rounds).wait(600) == 0


@pytest.mark.slow
def test_killed_twice_it_comes_to_the_same_driver(small: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    kill_while_driving(folder, 1, 0)
    kill_while_training(folder, 1, 0)
    finish(folder, 1)
    drivers = [place / "round-0" / "driver.onnx" for place in (folder, small)]
    assert drivers[0].read_bytes() == drivers[1].read_bytes()


def _has_results(trial: Path) -> bool:
    return any(trial.glob("*/*.json"))


@pytest.mark.slow
def test_killed_in_every_part_it_comes_to_the_same_driver(
    small: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "killed"
    for which in range(2):
        kill_while_driving(folder, 2, which)
        kill_while_training(folder, 2, which)
        trial = folder / f"round-{which}" / "trial"
        kill_when(folder, 2, partial(_has_results, trial))
    finish(folder, 2)
    drivers = [place / "round-1" / "driver.onnx" for place in (folder, small)]
    assert drivers[0].read_bytes() == drivers[1].read_bytes()


def test_another_seed_draws_other_weights_for_every_stage_and_the_same_routes() -> None:
    other = FULL.seeded(1)
    before = [one.seed for each in FULL.rounds for one in each.trainings]
    after = [one.seed for each in other.rounds for one in each.trainings]
    assert not set(before) & set(after)
    assert [each.seed for each in other.rounds] == [each.seed for each in FULL.rounds]
    assert FULL.seeded(0) == FULL


def test_a_course_that_overlooks_agents_tells_its_folder_so() -> None:
    course = FULL.overlooking(0.25)
    found = [one.augmentation for each in course.rounds for one in each.trainings]
    assert {(how.no_occ, how.overlooked) for how in found} == {(0.0, 0.25)}
    told = difference(json.loads(json.dumps(asdict(FULL))), asdict(course))
    assert told == ("rounds.0.trainings.0.augmentation.no_occ", "0.2", "0.0")


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_of_agents_that_is_none(share: float) -> None:
    with pytest.raises(TrainingError, match=f"overlooks {share} of the agents; it"):
        FULL.overlooking(share)


def test_more_workers_than_it_trains_with_do_not_matter() -> None:
    assert FULL.on(8) == FULL.on(4) != FULL.on(2)
    trainings = [one for each in FULL.on(8).rounds for one in each.trainings]
    assert max(each.workers for each in trainings) == 4


def test_frames_of_an_episode_named_twice_count_once(tmp_path: Path) -> None:
    file = write(tmp_path / "0.npz", arrays_of(3))
    other = write(tmp_path / "1.npz", arrays_of(2))
    assert frames_in([file, other, file]) == 5


@pytest.mark.parametrize("kept", [0, 100, -40])
def test_a_truncated_episode_is_named(tmp_path: Path, kept: int) -> None:
    file = write(tmp_path / "0.npz", arrays_of(2))
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(TrainingError, match=r"0\.npz: not an episode: ") as caught:
        frames_in([file])
    assert "\n" not in str(caught.value)


ONE = Round(1, 1, 1.0, (Training(steps=1),))


@pytest.mark.parametrize(
    ("rounds", "trial", "words"),
    [
        ((), Trial(), "the expert must drive the first round alone"),
        ((replace(ONE, expert_share=0.5),), Trial(), "the expert must drive"),
        ((ONE, replace(ONE, trainings=())), Trial(), "round 1 has no training"),
        ((ONE,), Trial(seed=1), "the trial and round 0 share the seed 1"),
    ],
)
def test_a_course_that_makes_no_sense(
    rounds: tuple[Round, ...], trial: Trial, words: str
) -> None:
    with pytest.raises(TrainingError, match=f"course: {words}"):
        Course(rounds, trial)


def test_few_episodes_leave_one_to_look_at() -> None:
    files = [Path(f"{number}.npz") for number in range(60)]
    assert held_out_files(files[:3]) == [Path("0.npz")]
    assert held_out_files(files[:40]) == [Path("7.npz"), Path("23.npz"), Path("39.npz")]
