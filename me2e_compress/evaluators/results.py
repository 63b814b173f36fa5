"""A results folder: one JSON file per route, and a manifest; and the drive into it."""

import hashlib
import json
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import write_json
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import Listener
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators.contract import Drive, Driven, Evaluator
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import VERSION, check_version, is_route_id

MANIFEST = "evaluation.json"
ROUTES = "routes"
# Key of a manifest: number of samples that latencies were drawn from. It is derived
# data, and not compared.
MEASURED = "latency_samples"
LARGEST_SET = 1_000_000  # most routes of a set that a manifest may claim


@dataclass
class ResultsFolder:
    """Results on disk; routes of ``corrupt`` files count as not driven."""

    path: Path
    made_by: dict[str, Any]
    corrupt: dict[Path, str] = field(default_factory=dict)

    @classmethod
    def create(
        cls, path: Path, made_by: dict[str, Any], measured: int | None = None
    ) -> Self:
        """Create the folder, or resume one of the same evaluation; others are refused.

        ``measured`` is the number of samples that latencies are drawn from, if any.
        """
        # Claim an empty folder
        with atomic.writing_errors(path, EvaluationError):
            path.mkdir(parents=True, exist_ok=True)
            if not (path / MANIFEST).exists():
                # A killed run of ours leaves only drafts
                names = {file.name for file in path.iterdir()}
                names = {name for name in names if not name.startswith(".")}
                if names - {ROUTES}:
                    why = f"not empty, and holds no {MANIFEST}"
                    raise EvaluationError(f"{path}: {why}")
                if names and any((path / ROUTES).iterdir()):
                    raise EvaluationError(f"{path}: holds routes but no {MANIFEST}")
            (path / ROUTES).mkdir(exist_ok=True)
            if not (path / MANIFEST).exists():
                drawn = {} if measured is None else {MEASURED: measured}
                write_json(path / MANIFEST, made_by | drawn, indent=1)
        folder = cls.open(path)
        # All options that decide the results must agree
        for key in sorted({*made_by, *folder.made_by} - {MEASURED}):
            old, new = folder.made_by.get(key), made_by.get(key)
            if old != new:
                raise EvaluationError(
                    f"{path}: holds the results of another evaluation: its {key} is "
                    f"{_short(old)}, this one's {_short(new)}; choose another folder"
                )
        return folder

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a folder; an EvaluationError if its manifest is missing or malformed."""
        with documents.reading(path / MANIFEST, EvaluationError, "not JSON"):
            made_by = documents.from_json(documents.read_bytes(path / MANIFEST))
        if not isinstance(made_by, dict) or not isinstance(made_by.get("routes"), list):
            raise EvaluationError(f"{path}: {MANIFEST} does not name its routes")
        # Drives of another version of the road are compared with none of this
        if "evaluator" not in made_by:
            check_version(path, made_by.get(VERSION))
        # Routes are file names; the set has all of them
        routes, names = made_by["routes"], f"{path}: {MANIFEST}"
        for route in routes:
            if not isinstance(route, str) or not is_route_id(route):
                raise EvaluationError(f"{names}: {_short(route)} is not a route")
        if len(set(routes)) < len(routes):
            raise EvaluationError(f"{names} names a route twice")
        size = made_by.get("set_size", len(routes))
        if type(size) is not int or not len(routes) <= size <= LARGEST_SET:
            raise EvaluationError(
                f"{names}: set_size is {_short(size)}, it must be {len(routes)} or more"
            )
        return cls(path, made_by)

    @property
    def set_size(self) -> int:
        """Number of routes of the whole set."""
        return int(self.made_by.get("set_size", len(self.made_by["routes"])))

    @property
    def measured(self) -> int | None:
        """Number of samples that latencies were drawn from, if any."""
        count = self.made_by.get(MEASURED)
        return count if type(count) is int and count > 0 else None

    def episodes(self) -> dict[str, Episode]:
        """Read every driven route, in the order of the evaluation."""
        by_route = {route: self._read(route) for route in self.made_by["routes"]}
        return {route: one for route, one in by_route.items() if one is not None}

    def keep(self, episode: Episode) -> None:
        """Write one route."""
        record = {"fingerprint": self._digest, "episode": episode.to_json()}
        with atomic.writing_errors(self._file(episode.route), EvaluationError):
            write_json(self._file(episode.route), record)

    @property
    def _digest(self) -> str:
        text = json.dumps(self.made_by, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def _file(self, route: str) -> Path:
        return self.path / ROUTES / f"{route}.json"

    def _read(self, route: str) -> Episode | None:
        path = self._file(route)
        if not path.exists():
            return None
        try:
            record = documents.from_json(documents.read_bytes(path))
            own = record.get("fingerprint") if isinstance(record, dict) else None
            if own != self._digest:
                raise ValueError("of another evaluation")
            episode = Episode.from_json(record["episode"])
            if episode.route != route:
                raise ValueError(f"it is of route {episode.route}")
            return episode
        except (OSError, ValueError, KeyError, TypeError) as error:
            self.corrupt[path] = " ".join(str(error).split())[:200]
            return None


def log_beside(folder: Path) -> Path:
    """Return the log of wall-clock times of a folder, which must not hold any."""
    resolved = Path(os.path.realpath(folder))
    return resolved.with_name(f"{resolved.name}.log")


def log_cost(folder: Path, driven: Driven) -> None:
    """Add a line on what a route cost to the log beside a folder."""
    episode, log = driven.episode, log_beside(folder)
    cost = {
        "route": episode.route,
        "frames": len(episode.frames),
        "decisions": len(episode.decisions),
        "seconds": round(driven.seconds, 3),
        "memory_mb": round(driven.memory_bytes / 1e6, 1),
    }
    with (
        atomic.writing_errors(log, EvaluationError),
        log.open("a", encoding="utf-8") as lines,
    ):
        mark = {} if lines.tell() else atomic.IN_JSON
        lines.write(f"{json.dumps(cost | mark)}\n")


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def drive_routes(
    evaluator: Evaluator,
    policy: Driver | None,
    drive: Drive,
    folder: Path,
    listener: Listener,
    stage: str = "evaluate",
) -> tuple[Episode, ...]:
    """Drive the routes that a folder lacks, store them, and return all in their order.

    The files do not depend on the number of workers, the engine or the clock, unless
    latency is measured during the run. Results that an evaluator reads without a policy
    are read again: its files may have changed.

    Raises:
        EvaluationError: The policy cannot be opened, the folder belongs to another
            evaluation or cannot be written, or the evaluator yields what it must not.
    """
    # Fail early on a policy or folder that cannot be used
    made_by = evaluator.made_by(policy, drive)
    routes, measured = [route.id for route in drive.routes], drive.latency.measured
    results, done = None, dict[str, Episode]()
    if routes:
        made_by |= {"set_size": drive.set_size, "routes": routes}
        results = ResultsFolder.create(folder, made_by, measured)
        done = results.episodes()
        for path, reason in results.corrupt.items():
            listener.on_warning(f"{path}: {reason}: driven again")
    # Keep and report each route as soon as it is driven
    missing = replace(drive, routes=[e for e in drive.routes if e.id not in done])
    total = len(routes) or evaluator.set_size
    listener.on_progress(stage, len(done), total, "routes")
    if missing.routes or not routes:
        for episode in evaluator.episodes(policy, missing, folder, listener):
            route, yields = episode.route, f"{evaluator.name} yields route"
            if not is_route_id(route):
                raise EvaluationError(
                    f"{yields} {route[:60]!r}: a name is made of letters, digits, '_'"
                    " and '-'"
                )
            if route in done:
                raise EvaluationError(f"{yields} {route} twice")
            if routes and route not in routes:
                raise EvaluationError(f"{yields} {route}, not of its drive")
            done[route] = episode
            if results is not None:
                results.keep(episode)
            listener.on_progress(stage, len(done), max(total, len(done)), "routes")
    # Routes that the evaluator alone knows are kept once all are driven
    if lost := [route for route in routes if route not in done]:
        raise EvaluationError(f"{evaluator.name} did not drive route {lost[0]}")
    if not done:
        raise EvaluationError(f"{evaluator.name} yields no episode")
    if results is None:
        size = max(evaluator.set_size, len(done))
        made_by |= {"set_size": size, "routes": list(done)}
        results = ResultsFolder.create(folder, made_by, measured)
        for episode in done.values():
            results.keep(episode)
    return tuple(done[route] for route in routes or done)
