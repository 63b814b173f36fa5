"""Which recording belongs to which record."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from me2e_compress.evaluators.bench2drive.records import RouteRecord
from me2e_compress.evaluators.bench2drive.result_files import ResultFile


class DriveRecordings:
    """Finds the recording of a record, and those that are of none.

    The name of a drive ends in the time of its start, so another drive of the same
    route has another. A folder on the way to the recording is called after it, or the
    file is; agents may put the name of the routes' file before it. A recording that
    lies beside the only record of a folder is that record's.

    Args:
        paths: Of all recordings; or of all logs, which are found alike.
        results: All results files.
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
        """Return the recordings of a record, the best fitting first; mostly one."""
        found = self._named(record.recording) if record.recording else ()
        if not found:
            where = self._beside.get(record.content)
            found = tuple(path for path in self._names if path.parent == where)
            found = found if len(found) == 1 else ()
        self._taken.update(found)
        return found

    @property
    def of_none(self) -> list[Path]:
        """Recordings that are of no record asked for so far."""
        return [path for path in self._names if path not in self._taken]

    def _named(self, name: str) -> tuple[Path, ...]:
        exact, prefixed = list[Path](), list[Path]()
        for path, names in self._names.items():
            if name in names:
                exact.append(path)
            elif any(each.endswith(f"_{name}") for each in names):
                prefixed.append(path)
        return (*exact, *prefixed)
