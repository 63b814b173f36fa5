"""An engine's answers beside its graph, which is run with the engine's state."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol, TypeAlias, TypeVar

import numpy as np

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import DTYPES, Session

Arrays: TypeAlias = Mapping[str, Array]
T_co = TypeVar("T_co", covariant=True)


class Indexed(Protocol[T_co]):
    """A recording that is read by index."""

    def __len__(self) -> int:
        """Count the frames."""
        ...

    def __getitem__(self, index: int, /) -> T_co:
        """Read one frame."""
        ...


class EngineRun:
    """What an engine answered, and what a graph answers with the engine's state.

    Attributes:
        session: The graph that the engine was built from.
        frames: The recording.
        dump: What the engine answered, by frame.
        names: The outputs that both have.
    """

    def __init__(
        self, session: Session, frames: Indexed[Frame], dump: Indexed[Arrays]
    ) -> None:
        self.session, self.frames, self.dump = session, frames, dump
        self.names = [name for name in session.outputs if name in dump[0]]

    def __len__(self) -> int:
        return len(self.frames)

    def follow(
        self, session: Session, names: Sequence[str]
    ) -> Iterator[tuple[Arrays, Arrays]]:
        """Run a graph over all frames; yield its inputs and the outputs that are named.

        State comes from the dump where it has it, else from the frame before of this
        run, and is reset where a scene begins.
        """
        own = [each for each in session.recurrent.values() if each not in self.dump[0]]
        asked = list(dict.fromkeys([*names, *own]))
        state = dict[str, Array]()
        for index in range(len(self)):
            frame = self.frames[index]
            if index == 0 or frame.starts_scene:
                state = session.first_state(frame.arrays)
            inputs = {**frame.arrays, **state}
            answers = session.run(inputs, asked)
            yield inputs, {name: answers[name] for name in names}
            after = {**answers, **self.dump[index]}
            # a copy: the session may write its next answers into the same memory
            state = {
                name: np.array(after[output], DTYPES[session.inputs[name].type])
                for name, output in session.recurrent.items()
            }

    def check(self, index: int, truth: Arrays) -> None:
        """Check the engine's answers to a frame against those of its graph.

        Raises:
            EvaluationError: an output has another shape, or is not finite.
        """
        for name in self.names:
            value, right = self.dump[index][name], truth[name]
            if value.shape != right.shape:
                raise EvaluationError(
                    f"output {name} is {list(value.shape)} in the dump at frame"
                    f" {index}, {list(right.shape)} in the graph"
                )
            if value.dtype.kind == "f" and not np.isfinite(value).all():
                kind = "NaN" if np.isnan(value).any() else "infinite"
                at = np.argwhere(~np.isfinite(value))[0].tolist()
                raise EvaluationError(
                    f"output {name} of the dump is {kind} at frame {index}, {at}"
                )
