"""Match recordings to records."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from me2e_compress.evaluators.bench2drive.records import RouteRecord
from me2e_compress.evaluators.bench2drive.result_files import ResultFile


class DriveRecordings:
    """Finds the recording (or log) of a record, and those that match no record.

    A drive's name ends in its start time, so repeated drives of a route differ. The
    recording's folder or file has that name, sometimes with the name of the routes file
    as a prefix. A recording next to the only record of a folder belongs to that record.
    """

    def __init__(self, paths: Sequence[Path], results: Sequence[ResultFile]) -> None:
        self._names = {path: (*path.parent.parts, path.stem) for path in paths}
        self._taken = set[Path]()
        alone = Counter(file.path.parent for file in results)
        self._beside = {
            record.content: file.path.parent
            for file in results
            if alone[file.path.parent] == 1 and len(file.records) == 1
            for record in file.records
        }

    def of(self, record: RouteRecord) -> tuple[Path, ...]:
        """Return the recordings of a record, best match first; usually one."""
        found = self._named(record.recording) if record.recording else ()
        if not found:
            where = self._beside.get(record.content)
            found = tuple(path for path in self._names if path.parent == where)
            found = found if len(found) == 1 else ()
        self._taken.update(found)
        return found

    @property
    def of_none(self) -> list[Path]:
        """Recordings that matched no record asked for so far."""
        return [path for path in self._names if path not in self._taken]

    def _named(self, name: str) -> tuple[Path, ...]:
        exact, prefixed = list[Path](), list[Path]()
        for path, names in self._names.items():
            if name in names:
                exact.append(path)
            elif any(each.endswith(f"_{name}") for each in names):
                prefixed.append(path)
        return (*exact, *prefixed)
