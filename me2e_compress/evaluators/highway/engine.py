"""Engines that drive routes: processes of this machine, or a Ray cluster."""

import queue
import socket
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.worker import Driven, Job, RouteWorker
from me2e_compress.extras import explained
from me2e_compress.simulator.routes import Route


class Engine(Protocol):
    """Drives independent routes, several at a time."""

    def drive(self, job: Job, routes: Sequence[Route]) -> Iterator[Driven]:
        """Yield each route once, as it finishes; routes begin in the order given."""
        ...


@dataclass(frozen=True)
class LocalEngine:
    """Spawned processes of this machine, each watched by a thread."""

    workers: int = 1

    def drive(self, job: Job, routes: Sequence[Route]) -> Iterator[Driven]:
        """Yield each route as it finishes; closing the iterator ends the processes."""
        # queues between the threads and this one
        waiting: queue.SimpleQueue[Route] = queue.SimpleQueue()
        finished: queue.SimpleQueue[Driven | Exception] = queue.SimpleQueue()
        for route in routes:
            waiting.put(route)
        stop = threading.Event()
        threads = [
            threading.Thread(target=_watch, args=(job, waiting, finished, stop))
            for _ in range(min(self.workers, len(routes)))
        ]
        try:
            for thread in threads:
                thread.start()
            # an error of any thread ends the evaluation
            for _ in routes:
                driven = finished.get()
                if isinstance(driven, Exception):
                    raise driven
                yield driven
        finally:
            stop.set()
            for thread in threads:
                thread.join()


def _watch(
    job: Job,
    waiting: "queue.SimpleQueue[Route]",
    finished: "queue.SimpleQueue[Driven | Exception]",
    stop: threading.Event,
) -> None:
    """Drive waiting routes in one process; errors go to the main thread."""
    worker = RouteWorker(job)
    try:
        while not stop.is_set():
            driven = worker.drive(waiting.get_nowait(), stop)
            if driven is None:
                return
            finished.put(driven)
    except queue.Empty:
        return
    except Exception as error:
        finished.put(error)
    finally:
        worker.close()


CONNECT_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class RayEngine:
    """One Ray actor per worker; model files must be readable from every node.

    Each worker takes one CPU of the cluster. Without an address, a cluster is started
    on this machine for the duration of the evaluation.
    """

    workers: int = 1
    address: str | None = None

    def drive(self, job: Job, routes: Sequence[Route]) -> Iterator[Driven]:
        """Yield each route as it finishes."""
        ray = _ray()
        self._connect(ray)
        try:
            remote = ray.remote(num_cpus=1)(RouteWorker)
            actors = [remote.remote(job) for _ in range(min(self.workers, len(routes)))]
            pool: Any = ray.util.ActorPool(actors)
            yield from pool.map_unordered(
                lambda actor, route: actor.drive.remote(route), routes
            )
            ray.get([actor.close.remote() for actor in actors])
        finally:
            ray.shutdown()

    def _connect(self, ray: Any) -> None:
        if self.address is None:
            ray.init(
                num_cpus=self.workers, include_dashboard=False, log_to_driver=False
            )
            return
        try:
            _check_reachable(self.address)
            ray.init(address=self.address, log_to_driver=False)
        except OSError as error:
            raise EvaluationError(f"ray: no cluster at {self.address}") from error


def _check_reachable(address: str) -> None:
    """Fail within seconds if nothing listens: Ray itself tries for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT_S).close()


def _ray() -> Any:
    try:
        import ray
        import ray.util
    except ImportError as error:
        raise explained(error) from error
    return ray
