"""What fails on the way: a policy, its process, the disk, the whole run."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

import me2e_compress
from me2e_compress import EvaluateOptions, evaluate
from me2e_compress.base.errors import EvaluationError
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.results import ResultsFolder
from me2e_compress.metrics.episode import Ending, Episode
from me2e_compress.simulator.routes import Route, save_routes
from tests.evaluators.highway.drivers import CROSSING, EXIT, PARKED, MisbehavingDriver
from tests.evaluators.highway.evaluations import driven, made_by
from tests.support.command import contents

BLIND = "models.driver.expert:Blind"


@pytest.mark.usefixtures("here")
def test_a_killed_run_goes_on_with_nothing_lost_or_repeated(tmp_path: Path) -> None:
    manifest, folder = tmp_path / "routes.json", tmp_path / "results"
    routes = tuple(Route(f"exit_{k}", "HighwayExit", k) for k in range(4))
    save_routes(routes, manifest)
    program = (
        "import sys; from me2e_compress import EvaluateOptions, evaluate;"
        "evaluate(sys.argv[3], sys.argv[2], EvaluateOptions(routes=sys.argv[1]))"
    )
    command = [sys.executable, "-c", program, str(manifest), str(folder), BLIND]
    with subprocess.Popen(command, start_new_session=True) as running:
        written = folder / "routes"
        while len(list(written.glob("*.json")) if written.exists() else ()) < 1:
            assert running.poll() is None, "it ended before it could be killed"
            time.sleep(0.02)
        os.killpg(running.pid, signal.SIGKILL)
    finished = {path.name: path.read_bytes() for path in written.glob("*.json")}
    assert 1 <= len(finished) < len(routes)

    options = EvaluateOptions(routes=str(manifest))
    evaluate(BLIND, folder, options)
    log = (tmp_path / "results.log").read_text().splitlines()
    logged = [json.loads(line)["route"] for line in log]

    assert sorted(logged) == sorted(route.id for route in routes)
    now = contents(folder)
    assert all(now[f"routes/{name}"] == data for name, data in finished.items())
    undisturbed = tmp_path / "undisturbed"
    evaluate(BLIND, undisturbed, options)
    assert contents(undisturbed) == now


@pytest.mark.usefixtures("here")
def test_a_full_disk_is_one_line_and_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "results"
    two = (CROSSING, PARKED)
    ResultsFolder.create(folder, made_by(two), 3)

    def no_space(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("me2e_compress.base.atomic.os.fsync", no_space)
        with pytest.raises(EvaluationError, match="written: No space") as caught:
            driven(folder, two)
    assert "\n" not in str(caught.value)
    assert list(contents(folder)) == ["evaluation.json"]

    assert len(driven(folder, two)) == 2


def failed(
    folder: Path, way: str, limit_s: float = 60.0, routes: Sequence[Route] = (PARKED,)
) -> tuple[Episode, ...]:
    return driven(folder, routes, MisbehavingDriver(way), Drive(frame_limit_s=limit_s))


def test_a_policy_that_hangs_fails_and_the_run_goes_on(tmp_path: Path) -> None:
    episodes = failed(tmp_path / "results", "hang", 0.5, (EXIT, PARKED))

    assert [episode.ending for episode in episodes] == [Ending.POLICY_FAILED] * 2
    assert {episode.failure for episode in episodes} == {"no plan within 0.5 s"}
    # Nineteen frames at up to 8 m/s of a route of more than 100 m.
    assert all(0.0 < episode.completion_percent < 10.0 for episode in episodes)


def test_a_policy_that_takes_its_process_down_fails(tmp_path: Path) -> None:
    episodes = failed(tmp_path / "results", "die")

    failures = [episode.failure for episode in episodes]
    assert failures == ["the policy ended its process with code 7"]


def test_a_process_that_was_killed_is_not_the_policys_fault(tmp_path: Path) -> None:
    words = r"route \w+: its process was killed \(out of memory\?\)"

    with pytest.raises(EvaluationError, match=words):
        failed(tmp_path / "results", "killed")
    assert list(contents(tmp_path / "results")) == ["evaluation.json"]


@pytest.mark.usefixtures("here")
def test_a_failed_route_is_a_result_like_any_other(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    episodes = failed(folder, "raise")

    assert failed(folder, "raise") == episodes
    assert len((tmp_path / "results.log").read_text().splitlines()) == 1


# Workers run no code of the current folder, and nobody asks the network.


OURS = str(Path(me2e_compress.__file__).parents[1])
TRAP = """
from pathlib import Path
Path(__file__).with_suffix(".sprung").touch()
raise SystemExit("trapped")
"""
TRAPS = ("me2e_compress", "json", "numpy", "pickle", "multiprocessing", "onnxruntime")
WATCH = """
import sys
from pathlib import Path

def watch(event, given):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.sendto"):
        if not isinstance(given[1], (bytes, str)) or event == "socket.getaddrinfo":
            with Path({!r}).open("a") as file:
                file.write(f"{{event}} {{given!r}}\\n")

sys.addaudithook(watch)
"""
START = "import sys; from me2e_compress.cli import main; sys.exit(main())"
WORDS = ("evaluate", "highway", "-o", "out", "--routes", "2", "--workers", "2")


@pytest.mark.slow
def test_workers_import_nothing_from_here_and_ask_nobody(tmp_path: Path) -> None:
    here, site = tmp_path / "here", tmp_path / "site"
    here.mkdir()
    site.mkdir()
    for name in TRAPS:
        (here / f"{name}.py").write_text(TRAP)
    (site / "sitecustomize.py").write_text(WATCH.format(str(tmp_path / "asked")))

    done = subprocess.run(
        [sys.executable, "-P", "-c", START, *WORDS],
        cwd=here,
        env={"HOME": str(tmp_path), "PYTHONPATH": f"{site}:{OURS}"},
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert list(here.glob("*.sprung")) == []
    assert not (tmp_path / "asked").exists(), (tmp_path / "asked").read_text()
