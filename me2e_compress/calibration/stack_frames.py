"""Recorded frames as the graphs of a stack of several files are fed."""

import dataclasses
from functools import cached_property
from pathlib import Path
from typing import Self

import onnx_ir as ir

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError
from me2e_compress.graph import JoinedStack, LoadedModel, sha256_of
from me2e_compress.graph.stack.part_graph import PartGraph
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, detached


class StackFrames(CalibrationSet):
    """A recording as one graph of a stack is fed.

    The joined graph has the first values of the state with every frame, of which
    replays read those where a scene begins. Where other files run at first frames, its
    scenes begin one frame later, with the state that those give. A file for first
    frames has those alone, each a scene of its own, and what other files feed it.
    """

    def __init__(
        self,
        folder: str | Path,
        stack: JoinedStack,
        file: PartGraph | None = None,
        provider: Provider = CPU,
    ) -> None:
        super().__init__(folder)
        self._recorded = CalibrationSet(folder)
        self._stack, self._file, self._provider = stack, file, provider
        if stack.first is None:
            return
        opening = set(self.scenes)
        places = [at for at in self.places if (at in opening) == (file is not None)]
        if not places:
            runs = stack.path.name if file is None else file.label
            raise FramesError(
                f"{runs}: runs at none of {len(self)} frames, by {self.folder}"
                "/scenes.json"
            )
        self._rows = places
        self.files = tuple(self.files[at] for at in places)
        self.scenes = tuple(
            at
            for at, place in enumerate(places)
            if file is not None or place - 1 in opening
        )

    def of_file(self, file: PartGraph) -> Self:
        """Return the same frames as a file for first frames is fed."""
        return type(self)(self.folder, self._stack, file, self._provider)

    @property
    def fingerprint(self) -> str:
        """The recording's, and the stack's where it computes what is fed."""
        if self._stack.first is None:
            return self._recorded.fingerprint
        label = "" if self._file is None else self._file.label
        return f"{self._recorded.fingerprint} {label} {sha256_of(self._stack.path)}"

    def __getitem__(self, index: int) -> Frame:
        """Read one frame, and compute what the recording does not hold of it."""
        first_values = self._stack.first_values
        if self._stack.first is None:
            frame = super().__getitem__(index)
            held = {**first_values, **frame.arrays}
            return dataclasses.replace(frame, arrays=held)
        place = self._rows[index]
        if self._file is not None:
            return Frame(index, True, self._fed(self._recorded[place], self._file))
        frame, starts = self._recorded[place], index in self.scenes
        state = self._state(self._recorded[place - 1]) if starts else {}
        held = {**first_values, **frame.arrays, **state}
        return dataclasses.replace(frame, index=index, starts_scene=starts, arrays=held)

    def check(self, model: ir.Model) -> None:
        """Read every frame of the recording, and check it against the whole stack."""
        self._recorded.check(model)

    def _state(self, opening: Frame) -> dict[str, Array]:
        """Run a first frame; return what is fed to the next."""
        recurrent = self._stack.recurrent
        found = self._session.run(self._feeds(opening), list(set(recurrent.values())))
        return detached({name: found[answer] for name, answer in recurrent.items()})

    def _fed(self, opening: Frame, file: PartGraph) -> dict[str, Array]:
        """Run a first frame; return what a file of it is fed."""
        joined, feeds = self._stack.joined, self._feeds(opening)
        sources = joined.at_first.sources[file.part]
        names = {
            name: joined.names.public(*source)
            for name, source in sources.items()
            if source.part
        }
        found = self._session.run(feeds, list(set(names.values()))) if names else {}
        given = {name: found[public] for name, public in names.items()}
        rest = {n: feeds[each.name] for n, each in sources.items() if not each.part}
        return detached({**rest, **given})

    def _feeds(self, opening: Frame) -> dict[str, Array]:
        held = {**self._stack.first_values, **opening.arrays}
        return {**held, **self._session.first_state(held)}

    @cached_property
    def _session(self) -> Session:
        first = self._stack.first or self._stack.model
        return Session(first, release=True, provider=self._provider)


def recording_of(
    loaded: LoadedModel, folder: str | Path, provider: Provider = CPU
) -> CalibrationSet:
    """Open a recording as the graph of a model is fed; check every frame.

    Raises:
        FramesError: there is no such recording, or a frame does not fit the model.
    """
    if loaded.stack is None:
        recording = CalibrationSet(folder)
    else:
        recording = StackFrames(folder, loaded.stack, provider=provider)
    recording.check(loaded.model)
    return recording
