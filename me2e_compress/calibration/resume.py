"""Checkpoints of a long calibration, so that it can resume after a kill."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from me2e_compress.calibration.archives import archive_of, load_arrays
from me2e_compress.errors import FramesError
from me2e_compress.registry import documents
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.runtime.frames import Array

_STATE = "state/"


@dataclasses.dataclass(frozen=True)
class CalibrationState:
    """Frames done in one pass, results so far, and the state for the next frame."""

    done: int = 0
    results: Mapping[str, Array] = dataclasses.field(default_factory=dict)
    state: Mapping[str, Array] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class CalibrationCheckpoint:
    """The file of a calibration's progress; a path of None keeps nothing.

    ``key`` identifies the calibration: digest of the graph, tensors, frames, ...
    """

    path: Path | None
    key: Mapping[str, object]
    every: int = 8

    def read(self) -> CalibrationState:
        """Read the progress; an empty one if there is no file."""
        if self.path is None or not self.path.is_file():
            return CalibrationState()
        try:
            found = load_arrays(self.path, "a checkpoint")
            key = documents.from_json(str(found.pop("key")))
            done = int(str(found.pop("done")))
        except (ValueError, KeyError) as error:
            raise FramesError(f"{self.path}: not a checkpoint ({error})") from error
        # A checkpoint of another calibration is refused.
        self._check(key)
        return CalibrationState(
            done,
            {name: a for name, a in found.items() if not name.startswith(_STATE)},
            {
                name.removeprefix(_STATE): array
                for name, array in found.items()
                if name.startswith(_STATE)
            },
        )

    def write(self, progress: CalibrationState) -> None:
        """Write the progress atomically."""
        if self.path is None:
            return
        state = {_STATE + name: array for name, array in progress.state.items()}
        # The state shares the archive, under a prefix.
        head = {"key": np.array(json.dumps(self.key)), "done": np.array(progress.done)}
        write_bytes(self.path, archive_of({**head, **progress.results, **state}))

    def due(self, done: int, total: int) -> bool:
        """Return whether it is time to write."""
        return self.path is not None and (done % self.every == 0 or done == total)

    def clear(self) -> None:
        """Remove the file of a finished calibration."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _check(self, key: object) -> None:
        wanted = json.loads(json.dumps(self.key))
        if not isinstance(key, dict) or key.keys() != wanted.keys():
            raise FramesError(
                f"{self.path}: a checkpoint of another version; remove it"
            )
        if stale := [name for name in wanted if key[name] != wanted[name]]:
            raise FramesError(
                f"{self.path}: stale: a checkpoint of another {stale[0]}; remove it to"
                " begin again"
            )
