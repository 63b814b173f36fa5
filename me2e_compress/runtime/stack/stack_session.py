"""Run a stack of several files as one session."""

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Self

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.recurrence import SessionPort, not_fed_back
from me2e_compress.runtime.session import Session, zeros
from me2e_compress.runtime.stack.joints import FeedSource, Joints
from me2e_compress.runtime.stack.split_stack import SplitStack, is_stack


@dataclasses.dataclass(frozen=True)
class PartRun:
    """The inputs and outputs of one file of a stack at one frame, by its own names."""

    label: str
    feeds: Mapping[str, Array]
    values: Mapping[str, Array]


class StackSession:
    """The sessions of a stack's files, by label, as one session."""

    def __init__(
        self,
        stack: SplitStack,
        sessions: Mapping[str, AnySession],
        provider: Provider = CPU,
    ) -> None:
        self.stack = stack
        self.sessions = sessions
        self.provider = provider

    @classmethod
    def open(
        cls,
        stack: SplitStack,
        *,
        threads: int = 0,
        optimize: bool = True,
        stock: bool = False,
        release: bool = False,
        provider: Provider = CPU,
    ) -> Self:
        """Open every file; the options are those of :class:`Session`."""
        sessions = dict[str, Session]()
        for label, each in stack.files.items():
            try:
                sessions[label] = Session(
                    each.path,
                    threads=threads,
                    optimize=optimize,
                    stock=stock,
                    release=release,
                    provider=provider,
                )
            except GraphError as error:
                raise GraphError(f"{each.path}: {error}") from error
        return cls(stack, sessions, provider)

    @property
    def inputs(self) -> Mapping[str, SessionPort]:
        """The inputs by name, in order."""
        return self.stack.inputs

    @property
    def outputs(self) -> Mapping[str, SessionPort]:
        """The outputs present at every frame by name, in order."""
        return self.stack.outputs

    @property
    def metadata(self) -> Mapping[str, str]:
        """The metadata of the stack."""
        return self.stack.metadata

    @property
    def recurrent(self) -> Mapping[str, str]:
        """``{input: output}`` of the state that is fed forward."""
        return self.stack.recurrent

    def first_state(self, held: Mapping[str, Array]) -> dict[str, Array]:
        """Return the first values of the recurrent inputs that a first frame reads.

        ``held`` takes precedence, then the stack's first values, then zeros.
        """
        known = {**self.stack.first_values, **held}
        read = {name for _, _, name in self.stack.at_first.outside()}
        return {
            name: known[name] if name in known else zeros(name, self.inputs[name])
            for name in self.recurrent
            if name in read
        }

    def run(
        self,
        feeds: Mapping[str, Array],
        outputs: Sequence[str] | None = None,
        *,
        first: bool = False,
    ) -> dict[str, Array]:
        """Run every file once, in topological order."""
        wanted = self.outputs if outputs is None else outputs
        runs = {each.label: each.values for each in self.runs(feeds, first=first)}
        graphs = self._joints(first=first).graphs
        # Look up each output by the part that computes it.
        found = dict[str, Array]()
        for name in wanted:
            part, output = self.stack.answers[name]
            found[name] = runs[graphs[part].label][output]
        return found

    def runs(
        self,
        feeds: Mapping[str, Array],
        *,
        first: bool = False,
        parts: Collection[str] | None = None,
    ) -> Iterator[PartRun]:
        """Run the files lazily, one for each item; ``parts`` restricts them."""
        joints = self._joints(first=first)
        values = dict[FeedSource, Array]()
        for part in joints.order:
            if parts is not None and part not in parts:
                continue
            label = joints.graphs[part].label
            session = self.sessions[label]
            # Feed the file from earlier files, the frame and the state.
            fed = {
                name: values[source] if source.part else self._fed(source.name, feeds)
                for name, source in joints.sources[part].items()
                if name in session.inputs
            }
            try:
                found = session.run(fed)
            except (FramesError, GraphError) as error:
                raise type(error)(f"{label}: {error}") from error
            values |= {FeedSource(part, name): value for name, value in found.items()}
            yield PartRun(label, fed, found)

    def _joints(self, *, first: bool) -> Joints:
        return self.stack.at_first if first else self.stack.at_next

    def _fed(self, name: str, feeds: Mapping[str, Array]) -> Array:
        if name in feeds:
            return feeds[name]
        reason = not_fed_back(name, self.inputs, self.outputs)
        raise FramesError(
            f"input {name} is missing; there is {', '.join(feeds) or 'none'}{reason}"
        )


def open_session(
    path: Path,
    *,
    threads: int = 0,
    optimize: bool = True,
    stock: bool = False,
    release: bool = False,
    provider: Provider = CPU,
    said: Mapping[str, str] | None = None,
) -> AnySession:
    """Open an ONNX file, or the stack that a TOML file describes.

    The options are those of :class:`Session`.
    """
    # The suffix tells a stack from a single graph.
    if is_stack(path):
        return StackSession.open(
            SplitStack.load(path).saying(said or {}),
            threads=threads,
            optimize=optimize,
            stock=stock,
            release=release,
            provider=provider,
        )
    return Session(
        path,
        threads=threads,
        optimize=optimize,
        stock=stock,
        release=release,
        provider=provider,
        said=said,
    )
