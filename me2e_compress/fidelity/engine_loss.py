"""What an engine lost, output by output: to quantization and to compilation."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from me2e_compress.base.errors import EvaluationError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.engine_dump import EngineDump
from me2e_compress.fidelity import ALIVE
from me2e_compress.fidelity.compare import Tally
from me2e_compress.fidelity.liveness import OutputTally
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import DTYPES, Session

Arrays: TypeAlias = Mapping[str, Array]
Frames: TypeAlias = CalibrationSet | Sequence[Frame]
Dump: TypeAlias = EngineDump | Sequence[Arrays]


class EngineRun:
    """What an engine answered, and what a graph answers with the engine's state.

    Attributes:
        session: The graph that the engine was built from.
        frames: The recording.
        dump: What the engine answered, by frame.
        names: The outputs that both have.
    """

    def __init__(self, session: Session, frames: Frames, dump: Dump) -> None:
        self.session, self.frames, self.dump = session, frames, dump
        self.names = [name for name in session.outputs if name in dump[0]]

    def __len__(self) -> int:
        return len(self.frames)

    def run_graph(
        self, session: Session, names: Sequence[str]
    ) -> Iterator[tuple[Arrays, Arrays]]:
        """Run a graph over all frames; yield its inputs and its outputs ``names``.

        State is that of the dump, or of this run's last frame where the dump lacks it,
        and is reset where a scene begins.
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


@dataclasses.dataclass(frozen=True)
class OutputLoss:
    """What one output lost, in dB of SQNR over all frames; infinite where nothing.

    It is -infinity where the graph or its source is not finite.

    Attributes:
        quantization_db: The graph against its float source; None without one.
        compilation_db: The engine, and the host that feeds it, against the graph.
        all_db: The engine against the float source, or against the graph without one.
        moves: Standard deviation of the engine's answers over the frames, as a share of
            the source's, or the graph's without one; None if those rest.
        dead: What is wrong if it moves hardly at all; empty otherwise.
    """

    name: str
    quantization_db: float | None
    compilation_db: float
    all_db: float
    moves: float | None
    dead: str


def split_losses(
    run: EngineRun,
    source: Session | None,
    alive: float = ALIVE,
    on_frame: Callable[[int], None] = lambda index: None,
) -> tuple[OutputLoss, ...]:
    """Run both graphs side by side over the frames, and split what each output lost.

    An output is dead that moves less than ``alive`` of what it should. ``on_frame`` is
    called with the index of every frame.

    Raises:
        EvaluationError: an output has another shape in the graph than in the engine or
            the source, or one of the engine is not finite.
    """
    names = run.names
    movements = {name: OutputTally(name) for name in names}
    compiled, whole = ({name: Tally(name) for name in names} for _ in range(2))
    known = [] if source is None else [each for each in names if each in source.outputs]
    quantized = {name: Tally(name) for name in known}
    floats = iter(()) if source is None else run.run_graph(source, known)
    for index, (_, truth) in enumerate(run.run_graph(run.session, names)):
        on_frame(index)
        run.check(index, truth)
        dumped, (_, exact) = run.dump[index], next(floats, (None, {}))
        for name in names:
            right = exact.get(name, truth[name])
            if name in quantized:
                quantized[name].add(right, truth[name], index)
            compiled[name].add(truth[name], dumped[name], index)
            whole[name].add(right, dumped[name], index)
            movements[name].add(right, dumped[name])
    moved = {name: movement.result(alive) for name, movement in movements.items()}
    return tuple(
        OutputLoss(
            name,
            quantized[name].sqnr_db if name in quantized else None,
            compiled[name].sqnr_db,
            whole[name].sqnr_db,
            moved[name].moves,
            str(moved[name]) if moved[name].is_dead else "",
        )
        for name in names
    )
