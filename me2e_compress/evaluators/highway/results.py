"""A results folder: one JSON file per route, and a manifest."""

import errno
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.worker import Driven, Job
from me2e_compress.metrics.episode import Episode
from me2e_compress.registry import documents
from me2e_compress.registry.drafts import IN_JSON
from me2e_compress.runtime.atomic import write_json
from me2e_compress.simulator.routes import (
    ROAD_VERSION,
    VERSION,
    Route,
    check_version,
    digest_of,
    is_route_id,
)
from me2e_compress.version import __version__

MANIFEST = "evaluation.json"
ROUTES = "routes"
BEFORE = {"latency_model": "drop", "drive_on": False}
"""Defaults for folders whose manifest lacks the key."""
MEASURED = "latency_samples"
"""Key of a manifest: number of samples that latencies were drawn from. It is
derived data, and not compared."""
LARGEST_SET = 1_000_000
"""Most routes of a set that a manifest may claim."""


def fingerprint(job: Job, routes: Sequence[Route], set_size: int) -> dict[str, Any]:
    """Return everything that decides the bytes of the results."""
    more: dict[str, Any] = {"drive_on": True} if job.conditions.drive_on else {}
    return {
        **more,
        VERSION: ROAD_VERSION,
        "version": __version__,
        "policy": job.driver.fingerprint(),
        "latency": job.conditions.latency.to_json(),
        "latency_model": job.conditions.latency_model.value,
        "dt_us": job.conditions.dt_us,
        "image_size": list(job.conditions.image_size),
        "weather": json.loads(json.dumps(asdict(job.conditions.weather))),
        "frame_limit_s": job.frame_limit_s,
        "set_size": set_size,
        "routes_sha256": digest_of(routes),
        "routes": [route.id for route in routes],
    }


@dataclass
class ResultsFolder:
    """Results on disk; every file is complete or absent.

    Routes of ``corrupt`` files, listed with the reason, count as not driven.
    """

    path: Path
    made_by: dict[str, Any]
    corrupt: dict[Path, str] = field(default_factory=dict)

    @classmethod
    def create(
        cls, path: Path, made_by: dict[str, Any], measured: int | None = None
    ) -> Self:
        """Create the folder, or resume one of the same evaluation; others are refused.

        ``measured`` is the number of samples of the trace that latencies are drawn
        from; None if none are drawn.
        """
        # claim an empty folder
        try:
            path.mkdir(parents=True, exist_ok=True)
            if not (path / MANIFEST).exists():
                _refuse_foreign(path)
            (path / ROUTES).mkdir(exist_ok=True)
            if not (path / MANIFEST).exists():
                drawn = {} if measured is None else {MEASURED: measured}
                write_json(path / MANIFEST, made_by | drawn, indent=1)
        except OSError as error:
            raise _unwritable(path, error) from error
        folder = cls.open(path)
        # all that decides the results must agree
        both = folder.made_by, made_by
        for key in sorted({*made_by, *folder.made_by} - {MEASURED}):
            old, new = (each.get(key, BEFORE.get(key)) for each in both)
            if old != new:
                raise EvaluationError(
                    f"{path}: holds the results of another evaluation: its {key} is "
                    f"{_short(old)}, this one's {_short(new)}; choose another folder"
                )
        return folder

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open an existing folder."""
        try:
            made_by = documents.from_json(documents.content(path / MANIFEST))
        except OSError as error:
            raise EvaluationError(
                f"{path}: not a results folder: {MANIFEST}: {error.strerror}"
            ) from error
        except documents.MalformedError as error:
            raise EvaluationError(
                f"{path}: not a results folder: {MANIFEST}: not JSON ({error})"
            ) from error
        _check_manifest(path, made_by)
        return cls(path, made_by)

    @property
    def set_size(self) -> int:
        """Number of routes of the whole set."""
        return int(self.made_by.get("set_size", len(self.made_by["routes"])))

    @property
    def measured(self) -> int | None:
        """Number of samples that latencies were drawn from, if any."""
        found = self.made_by.get(MEASURED)
        return found if type(found) is int and found > 0 else None

    @property
    def log(self) -> Path:
        """Log of wall-clock times, beside the folder, which must not hold any."""
        return log_beside(self.path)

    def episodes(self) -> dict[str, Episode]:
        """Read every driven route, in the order of the evaluation."""
        found = {route: self._read(route) for route in self.made_by["routes"]}
        return {route: one for route, one in found.items() if one is not None}

    def save(self, driven: Driven) -> None:
        """Write one route, and log its cost."""
        episode = driven.episode
        cost = {
            "route": episode.route,
            "frames": len(episode.frames),
            "decisions": len(episode.decisions),
            "seconds": round(driven.seconds, 3),
            "memory_mb": round(driven.memory_bytes / 1e6, 1),
        }
        self.keep(episode)
        try:
            with self.log.open("a", encoding="utf-8") as log:
                mark = {} if log.tell() else IN_JSON
                log.write(f"{json.dumps(cost | mark)}\n")
        except OSError as error:
            raise _unwritable(self.log, error) from error

    def keep(self, episode: Episode) -> None:
        """Write one route."""
        record = {"fingerprint": self._digest, "episode": episode.to_json()}
        try:
            write_json(self._file(episode.route), record)
        except OSError as error:
            raise _unwritable(self._file(episode.route), error) from error

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
            record = documents.from_json(documents.content(path))
            if (
                not isinstance(record, dict)
                or record.get("fingerprint") != self._digest
            ):
                raise ValueError("of another evaluation")
            episode = Episode.from_json(record["episode"])
            if episode.route != route:
                raise ValueError(f"it is of route {episode.route}")
            return episode
        except (OSError, ValueError, KeyError, TypeError) as error:
            self.corrupt[path] = " ".join(str(error).split())[:200]
            return None


def log_beside(folder: Path) -> Path:
    """Return the path of the log of a results folder."""
    resolved = Path(os.path.realpath(folder))
    return resolved.with_name(f"{resolved.name}.log")


def _check_manifest(path: Path, made_by: object) -> None:
    """Check the parts that are read: routes, which are file names, and set size.

    Drives of the first road, or of another version, are compared with none of this.
    """
    if not isinstance(made_by, dict) or not isinstance(made_by.get("routes"), list):
        raise EvaluationError(f"{path}: {MANIFEST} does not name its routes")
    if "evaluator" not in made_by:  # another's drives are of no road of ours
        check_version(path, made_by.get(VERSION))
    routes = made_by["routes"]
    for route in routes:
        if not isinstance(route, str) or not is_route_id(route):
            raise EvaluationError(f"{path}: {MANIFEST}: {_short(route)} is not a route")
    if len(set(routes)) < len(routes):
        raise EvaluationError(f"{path}: {MANIFEST} names a route twice")
    size = made_by.get("set_size", len(routes))
    if type(size) is not int or not len(routes) <= size <= LARGEST_SET:
        raise EvaluationError(
            f"{path}: {MANIFEST}: set_size is {_short(size)}, it must be"
            f" {len(routes)} or more"
        )


def _refuse_foreign(path: Path) -> None:
    """Refuse a folder with foreign files; a killed run of ours leaves only drafts."""
    names = [file.name for file in path.iterdir() if not file.name.startswith(".")]
    if any(name != ROUTES for name in names):
        raise EvaluationError(f"{path}: not empty, and holds no {MANIFEST}")
    if names and any((path / ROUTES).iterdir()):
        raise EvaluationError(f"{path}: holds routes but no {MANIFEST}")


def _unwritable(path: Path, error: OSError) -> EvaluationError:
    if error.errno == errno.ENOSPC:
        return EvaluationError(
            f"{path}: the disk is full; written files are complete, run again to resume"
        )
    return EvaluationError(f"{path}: cannot be written: {error.strerror or error}")


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
