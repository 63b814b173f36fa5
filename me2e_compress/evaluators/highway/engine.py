"""Engines that drive routes: processes of this machine, watched, or a Ray cluster."""

from __future__ import annotations

import itertools
import queue
import signal
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.sharedctypes import SynchronizedArray
from typing import TYPE_CHECKING, Any, TypeAlias

import psutil

from me2e_compress.base.errors import EvaluationError, Me2eError
from me2e_compress.base.extras import with_install_hint
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators.contract import Drive, Driven, Engine
from me2e_compress.runtime.children import end_with_parent, spawn_context
from me2e_compress.simulator.routes import Route

if TYPE_CHECKING:  # highway-env takes a second to import: only who drives needs it
    from me2e_compress.simulator.world import World

POLL_S = 0.05

# The parent's end: routes go to the child, an episode or an error comes back
Line: TypeAlias = "Connection[Route, Driven | Me2eError]"
# [0] number of the policy call in progress, 0 between calls; [1] percent of the route
# passed
Heartbeat: TypeAlias = "SynchronizedArray[float]"


@dataclass
class RouteWorker:
    """Drives one route at a time in a separate process, started when needed."""

    policy: Driver
    conditions: Drive
    _running: tuple[SpawnProcess, Heartbeat, Line] | None = field(
        default=None, init=False
    )

    def drive(self, route: Route, stop: threading.Event | None = None) -> Driven | None:
        """Drive a route; a policy that hangs or crashes its process has failed.

        Returns None if ``stop`` was set meanwhile.

        Raises:
            EvaluationError: The process ended for another reason than the policy.
        """
        begun = time.perf_counter()
        if self._running is None:
            # The child has only its own end of the pipe
            context = spawn_context()
            heartbeat, (line, theirs) = context.Array("d", 2), context.Pipe()
            options = (theirs, heartbeat, self.policy, self.conditions)
            child = context.Process(target=_serve, args=options, daemon=True)
            child.start()
            theirs.close()
            self._running = child, heartbeat, line
        process, heartbeat, line = self._running
        line.send(route)
        # Watch the heartbeat: one call must not take too long
        call, since, limit_s = 0.0, begun, self.conditions.frame_limit_s
        try:
            while not line.poll(POLL_S):
                if stop is not None and stop.is_set():
                    self.close()
                    return None
                if heartbeat[0] != call:
                    call, since = heartbeat[0], time.perf_counter()
                elif call and time.perf_counter() - since > limit_s:
                    return self._failed(route, begun, f"no plan within {limit_s:g} s")
            answer = line.recv()
        # A closed pipe means that the process ended: during a call by the policy
        except (EOFError, BrokenPipeError, ConnectionResetError):
            process.join()
            code, killed = process.exitcode, process.exitcode == -signal.SIGKILL
            if killed or not heartbeat[0]:
                self.close()
                how = f"ended with code {code}"
                how = "was killed (out of memory?)" if killed else how
                words = f"route {route.id}: its process {how}"
                raise EvaluationError(words) from None
            failure = f"the policy ended its process with code {code}"
            return self._failed(route, begun, failure)
        if isinstance(answer, Me2eError):
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        if self._running is not None:
            process, _, line = self._running
            process.kill()
            process.join()
            line.close()
        self._running = None

    def _failed(self, route: Route, begun: float, failure: str) -> Driven:
        """Return the episode of a route whose process is lost, with its progress."""
        from me2e_compress.evaluators.highway.episode_recorder import failed_episode

        percent = self._running[1][1] if self._running else 0.0
        self.close()
        episode = failed_episode(route, percent, failure)
        return Driven(episode, time.perf_counter() - begun, 0)


def _serve(
    line: Connection[Driven | Me2eError, Route],
    heartbeat: Heartbeat,
    driver: Driver,
    conditions: Drive,
) -> None:
    """Drive the routes received until the other end of the pipe closes."""
    # The heartbeat tells the parent when a call of the policy began
    end_with_parent()
    calls = itertools.count(1)

    def on_query(world: World) -> None:
        heartbeat[1] = completion_percent(world)
        heartbeat[0] = float(next(calls))

    def on_answer() -> None:
        heartbeat[0] = 0.0

    # Drive until the parent closes its end; an error of ours goes to the parent
    try:
        from me2e_compress.evaluators.highway.episode_recorder import completion_percent
        from me2e_compress.evaluators.highway.runner import Listeners, drive

        policy, listeners = driver.open(), Listeners(on_query, on_answer)
        while True:
            route = line.recv()
            begun = time.perf_counter()
            episode = drive(route, policy, conditions, listeners)
            on_answer()
            memory = psutil.Process().memory_info().rss
            line.send(Driven(episode, time.perf_counter() - begun, memory))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except (Me2eError, ImportError) as error:
        explanation = with_install_hint(error)
        if not isinstance(explanation, Me2eError):
            raise
        line.send(explanation)


@dataclass(frozen=True)
class LocalEngine:
    """Spawned processes of this machine, each watched by a thread."""

    workers: int = 1

    def drive(
        self, policy: Driver, drive: Drive, routes: Sequence[Route]
    ) -> Iterator[Driven]:
        """Yield each route as it finishes; closing the iterator ends the processes."""
        # A thread takes an idle worker for each route
        count = max(1, min(self.workers, len(routes)))
        workers = [RouteWorker(policy, drive) for _ in range(count)]
        stop, idle = threading.Event(), queue.SimpleQueue[RouteWorker]()
        for worker in workers:
            idle.put(worker)

        def drive_route(route: Route) -> Driven | None:
            worker = idle.get()
            try:
                return worker.drive(route, stop)
            finally:
                idle.put(worker)

        threads = ThreadPoolExecutor(count)
        try:
            # An error of any route ends the evaluation
            for future in as_completed(threads.submit(drive_route, e) for e in routes):
                if (driven := future.result()) is not None:
                    yield driven
        finally:
            stop.set()
            threads.shutdown(cancel_futures=True)
            for worker in workers:
                worker.close()


CONNECT_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class RayEngine:
    """One Ray actor and CPU per worker; all nodes must be able to read the model.

    Without an address, a cluster is started on this machine meanwhile.
    """

    workers: int = 1
    address: str | None = None

    def drive(
        self, policy: Driver, drive: Drive, routes: Sequence[Route]
    ) -> Iterator[Driven]:
        """Yield each route as it finishes."""
        try:
            import ray
            import ray.util
        except ImportError as error:
            raise with_install_hint(error) from error
        self._connect(ray)
        # One actor per worker; each drives its routes in a process of its own
        try:
            remote: Any = ray.remote(num_cpus=1)(RouteWorker)
            count = min(self.workers, len(routes))
            actors = [remote.remote(policy, drive) for _ in range(count)]
            pool: Any = ray.util.ActorPool(actors)
            yield from pool.map_unordered(
                lambda actor, route: actor.drive.remote(route), routes
            )
            ray.get([actor.close.remote() for actor in actors])
        finally:
            ray.shutdown()

    def _connect(self, ray: Any) -> None:
        if self.address is None:
            alone = {"include_dashboard": False, "log_to_driver": False}
            ray.init(num_cpus=self.workers, **alone)
            return
        try:
            # Fail within seconds if nothing listens: Ray itself tries for minutes
            host, _, port = self.address.removeprefix("ray://").rpartition(":")
            if host and port.isdecimal():
                place = host, int(port)
                socket.create_connection(place, timeout=CONNECT_TIMEOUT_S).close()
            ray.init(address=self.address, log_to_driver=False)
        except OSError as error:
            raise EvaluationError(f"ray: no cluster at {self.address}") from error


def engine_named(words: str, workers: int) -> Engine:
    """Return the engine of ``local``, ``ray`` or ``ray:ADDRESS`` of a cluster."""
    name, _, address = words.partition(":")
    if words == "local":
        return LocalEngine(workers)
    if name == "ray":
        return RayEngine(workers, address or None)
    raise EvaluationError(f"no engine {words!r}; there are local, ray and ray:ADDRESS")
