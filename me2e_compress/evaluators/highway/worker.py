"""A process that drives routes, and its watchdog."""

from __future__ import annotations

import signal
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.sharedctypes import SynchronizedArray
from typing import TYPE_CHECKING, NoReturn, TypeAlias

import psutil

from me2e_compress.driving.policies import Driver
from me2e_compress.errors import EvaluationError, Me2eError
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.extras import explained
from me2e_compress.metrics.episode import Episode
from me2e_compress.runtime.children import end_with_parent, spawn_context
from me2e_compress.simulator.routes import Route

if TYPE_CHECKING:  # highway-env takes a second to import: only who drives needs it
    from me2e_compress.simulator.world import World

POLL_S = 0.05
FRAME_LIMIT_S = 60.0

Heartbeat: TypeAlias = "SynchronizedArray[float]"
"""[0] number of the policy call in progress, 0 between calls; [1] percent of
the route passed."""


@dataclass(frozen=True)
class Job:
    """What all routes of an evaluation have in common.

    A decision that takes longer than ``frame_limit_s`` makes the policy count as hung.
    """

    driver: Driver
    conditions: Conditions
    frame_limit_s: float = FRAME_LIMIT_S


@dataclass(frozen=True)
class Driven:
    """An episode, the wall-clock seconds and the resident memory that it took."""

    episode: Episode
    seconds: float
    memory_bytes: int


@dataclass
class RouteWorker:
    """Drives one route at a time in a separate process, started when needed."""

    job: Job
    _process: SpawnProcess | None = field(default=None, init=False)
    _heartbeat: Heartbeat | None = field(default=None, init=False)
    _line: Connection[Route, Driven | Me2eError] | None = field(
        default=None, init=False
    )

    def drive(self, route: Route, stop: threading.Event | None = None) -> Driven | None:
        """Drive a route; a policy that hangs or crashes its process has failed.

        Returns None if ``stop`` was set meanwhile.

        Raises:
            EvaluationError: The process ended for another reason than the policy.
        """
        begun = time.perf_counter()
        process, heartbeat, line = self._started()
        line.send(route)
        # watch the heartbeat: one call must not take too long
        asked, since = 0.0, begun
        while not _ready(line):
            if stop is not None and stop.is_set():
                self.close()
                return None
            if heartbeat[0] != asked:
                asked, since = heartbeat[0], time.perf_counter()
            elif asked and time.perf_counter() - since > self.job.frame_limit_s:
                limit = f"{self.job.frame_limit_s:g} s"
                return self._lost(route, begun, f"no plan within {limit}")
        # a closed pipe means that the process ended
        try:
            answer = line.recv()
        except (EOFError, ConnectionResetError):
            process.join()
            return self._lost(route, begun, self._cause(route, process))
        if isinstance(answer, Me2eError):
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._line is not None:
            self._line.close()
        self._process = self._heartbeat = self._line = None

    def _started(
        self,
    ) -> tuple[SpawnProcess, Heartbeat, Connection[Route, Driven | Me2eError]]:
        if self._process is None or self._heartbeat is None or self._line is None:
            # the child keeps only its own end of the pipe
            context = spawn_context()
            heartbeat = context.Array("d", 2)
            ours, theirs = context.Pipe()
            process = context.Process(
                target=_serve, args=(theirs, heartbeat, self.job), daemon=True
            )
            process.start()
            theirs.close()
            self._process, self._heartbeat, self._line = process, heartbeat, ours
        return self._process, self._heartbeat, self._line

    def _cause(self, route: Route, process: SpawnProcess) -> str:
        code = process.exitcode
        if code == -signal.SIGKILL or not self._heartbeat or not self._heartbeat[0]:
            self.close()
            killed = code == -signal.SIGKILL
            how = "was killed (out of memory?)" if killed else f"ended with code {code}"
            raise EvaluationError(f"route {route.id}: its process {how}")
        return f"the policy ended its process with code {code}"

    def _lost(self, route: Route, begun: float, failure: str) -> Driven:
        from me2e_compress.evaluators.highway.episode_recorder import failed_episode

        percent = self._heartbeat[1] if self._heartbeat else 0.0
        self.close()
        episode = failed_episode(route, percent, failure)
        return Driven(episode, time.perf_counter() - begun, 0)


def _ready(line: Connection[Route, Driven | Me2eError]) -> bool:
    try:
        return line.poll(POLL_S)
    except (BrokenPipeError, ConnectionResetError):
        return True


def _serve(
    line: Connection[Driven | Me2eError, Route], heartbeat: Heartbeat, job: Job
) -> None:
    """Drive the routes received until the other end of the pipe closes."""
    end_with_parent()
    try:
        _drive_routes(line, heartbeat, job)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except (Me2eError, ImportError) as error:
        told = explained(error)
        if not isinstance(told, Me2eError):
            raise
        line.send(told)


def _drive_routes(
    line: Connection[Driven | Me2eError, Route], heartbeat: Heartbeat, job: Job
) -> NoReturn:
    from me2e_compress.evaluators.highway.episode_recorder import completion_percent
    from me2e_compress.evaluators.highway.runner import Listeners, drive

    # the heartbeat tells the parent when a call of the policy began
    asked = 0

    def on_query(world: World) -> None:
        nonlocal asked
        asked += 1
        heartbeat[1] = completion_percent(world)
        heartbeat[0] = float(asked)

    def on_answer() -> None:
        heartbeat[0] = 0.0

    policy = job.driver.open()
    while True:
        route = line.recv()
        begun = time.perf_counter()
        listeners = Listeners(on_query, on_answer)
        episode = drive(route, policy, job.conditions, listeners)
        on_answer()
        memory = psutil.Process().memory_info().rss
        line.send(Driven(episode, time.perf_counter() - begun, memory))
