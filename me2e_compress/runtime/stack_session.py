"""Open a model by its path: an ONNX file, or a stack of several files."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from me2e_compress.errors import GraphError
from me2e_compress.graph import JoinedStack, is_stack
from me2e_compress.graph.recurrence import SessionPort
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, zeros


class StackSession:
    """A stack's joined graph, and that for first frames where it has one."""

    def __init__(
        self, stack: JoinedStack, at_next: Session, at_first: Session | None = None
    ) -> None:
        self._next, self._first = at_next, at_first or at_next
        self._first_values = stack.first_values
        self.provider, self.metadata = at_next.provider, at_next.metadata
        self.inputs: Mapping[str, SessionPort] = at_next.inputs
        self.outputs: Mapping[str, SessionPort] = {
            name: at_next.outputs[name] for name in stack.outputs
        }
        self.recurrent = {
            name: answer
            for name, answer in at_next.recurrent.items()
            if answer in self.outputs
        }

    def first_state(self, held: Mapping[str, Array]) -> dict[str, Array]:
        """Return the recurrent inputs that a first frame reads.

        ``held`` takes precedence, then the stack's first values, then zeros.
        """
        known = {**self._first_values, **held}
        return {
            name: known[name] if name in known else zeros(name, self.inputs[name])
            for name in self.recurrent
            if name in self._first.inputs
        }

    def run(
        self,
        feeds: Mapping[str, Array],
        outputs: Sequence[str] | None = None,
        *,
        first: bool = False,
    ) -> dict[str, Array]:
        """Run one inference of the graph for first frames or of that for others."""
        session = self._first if first else self._next
        return session.run(feeds, list(self.outputs) if outputs is None else outputs)


def open_session(
    path: Path,
    *,
    threads: int = 0,
    optimize: bool = True,
    stock: bool = False,
    int8_kernels: bool = False,
    release: bool = False,
    provider: Provider = CPU,
    said: Mapping[str, str] | None = None,
) -> AnySession:
    """Open an ONNX file, or the stack that a TOML file describes.

    The options are those of :class:`Session`.
    """
    opened = partial(
        Session,
        threads=threads,
        optimize=optimize,
        stock=stock,
        int8_kernels=int8_kernels,
        release=release,
        provider=provider,
    )
    if not is_stack(path):
        return opened(path, said=said)
    stack = JoinedStack.load(path)
    try:
        at_next = opened(stack.model, said=stack.saying(said or {}))
        return StackSession(
            stack, at_next, None if stack.first is None else opened(stack.first)
        )
    except GraphError as error:
        raise GraphError(f"{path}: {error}") from error
