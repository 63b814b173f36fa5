"""Engines that drive routes: processes of this machine, or a Ray cluster."""

import queue
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from me2e_compress.evaluators.highway.worker import Driven, Job, RouteWorker
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
