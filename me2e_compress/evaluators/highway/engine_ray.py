"""Routes on a Ray cluster, each driven in a separate process as usual."""

import socket
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.worker import Driven, Job, RouteWorker
from me2e_compress.extras import explained
from me2e_compress.simulator.routes import Route

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
