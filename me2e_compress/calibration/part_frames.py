"""Compute the inputs of one file of a stack, frame by frame."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

from me2e_compress.calibration.stream import Recording
from me2e_compress.errors import FramesError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.recurrence import SessionPort
from me2e_compress.runtime.session import Session, detached
from me2e_compress.runtime.stack.split_stack import SplitStack
from me2e_compress.runtime.stack.stack_session import StackSession


class PartFrames:
    """The frames of one file, computed on demand by the files that feed it.

    Only those files run; only the state is kept. A file for first frames has the first
    frame of every scene, each a scene of its own; the other file of that part has the
    rest, whose scenes begin one frame later. A file that runs at no frame is a
    FramesError.
    """

    def __init__(
        self,
        stack: SplitStack,
        label: str,
        whole: Recording,
        provider: Provider = CPU,
    ) -> None:
        self._stack, self._file = stack, stack.files[label]
        self._whole, self._provider = whole, provider
        scenes = frozenset(whole.scenes)
        first = stack.at_first.graphs[self._file.part].label
        other = stack.at_next.graphs.get(self._file.part)
        # The frames at which this file runs.
        self._rows = [
            at
            for at in range(len(whole))
            if (label == first and at in scenes)
            or (other is not None and label == other.label and at not in scenes)
        ]
        if not self._rows:
            raise FramesError(f"{label}: runs at none of {len(whole)} frames")
        self._openings = scenes
        self._next, self._state = 0, dict[str, Array]()

    @property
    def fingerprint(self) -> str:
        """The fingerprint of the whole recording, the stack and the file."""
        return part_fingerprint(self._stack, self._file.label, self._whole)

    @property
    def places(self) -> Sequence[int]:
        """Indices of these frames in the whole recording."""
        places = self._whole.places
        return tuple(places[at] for at in self._rows)

    @property
    def scenes(self) -> Sequence[int]:
        """Positions among these frames where a scene begins."""
        return self._scenes

    @cached_property
    def _scenes(self) -> tuple[int, ...]:
        opened = [max(at for at in self._openings if at <= row) for row in self._rows]
        return tuple(
            index
            for index, opens in enumerate(opened)
            if not index or opens != opened[index - 1]
        )

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[Frame]:
        """Compute the frames in order, one in memory at a time."""
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Compute one frame; continuing from the previous one is cheapest."""
        row = self._rows[index]
        opens = max(at for at in self._openings if at <= row)
        # Continue from the last frame, or from the scene's start.
        begin = self._next if opens < self._next <= row else opens
        for at in range(begin, row):
            self._step(at)
        fed = self._step(row)
        return Frame(self.places[index], index in self.scenes, detached(fed))

    def _step(self, at: int) -> Mapping[str, Array]:
        """Run one frame; return the inputs of the file, empty if it did not run."""
        frame, fed = self._whole[at], dict[str, Array]()
        if frame.starts_scene:
            self._state = self._session.first_state(frame.arrays)
        answers = dict[tuple[str, str], Array]()
        feeds = {**frame.arrays, **self._state}
        # Run only the files that feed this one.
        parts = {*self._needed, self._file.part}
        for run in self._session.runs(feeds, first=frame.starts_scene, parts=parts):
            if run.label == self._file.label:
                fed = dict(run.feeds)
            part = self._stack.files[run.label].part
            answers |= {(part, name): value for name, value in run.values.items()}
        # Keep the state that was computed; other state is not needed.
        known = self._stack.answers
        self._state = {
            name: answers[known[output]]
            for name, output in self._stack.recurrent.items()
            if known[output] in answers
        }
        self._next = at + 1
        return fed

    @cached_property
    def _needed(self) -> frozenset[str]:
        """The parts that feed the file, through edges or the state."""
        found, waiting = set[str](), [self._file.part]
        while waiting:
            for each in self._feeding(waiting.pop()):
                if each not in found:
                    found.add(each)
                    waiting.append(each)
        return frozenset(found)

    def _feeding(self, part: str) -> Iterator[str]:
        stack = self._stack
        for joints in (stack.at_first, stack.at_next):
            for source in joints.sources.get(part, {}).values():
                if source.part:
                    yield source.part
                elif source.name in stack.recurrent:
                    yield stack.answers[stack.recurrent[source.name]][0]

    @cached_property
    def _session(self) -> StackSession:
        sessions = dict[str, AnySession]()
        for label, each in self._stack.files.items():
            if each.part in self._needed:
                sessions[label] = Session(
                    each.path, release=True, provider=self._provider
                )
            elif each.part == self._file.part:
                sessions[label] = _FedOnly(each.inputs, self._provider)
        return StackSession(self._stack, sessions, self._provider)


def part_fingerprint(stack: SplitStack, label: str, whole: Recording) -> str:
    """Return the fingerprint of the frames of one file of a stack."""
    return f"{whole.fingerprint} {label} {stack.sha256()}"


@dataclasses.dataclass(frozen=True)
class _FedOnly:
    """Session of a file that is fed but never run."""

    inputs: Mapping[str, SessionPort]
    provider: Provider
    outputs: Mapping[str, SessionPort] = dataclasses.field(default_factory=dict)
    metadata: Mapping[str, str] = dataclasses.field(default_factory=dict)
    recurrent: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def first_state(self, held: Mapping[str, Array]) -> dict[str, Array]:
        return {}

    def run(
        self,
        feeds: Mapping[str, Array],
        outputs: Sequence[str] | None = None,
        *,
        first: bool = False,
    ) -> dict[str, Array]:
        return {}
