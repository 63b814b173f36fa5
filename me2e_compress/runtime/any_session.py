"""What can be run over frames: a graph, or a stack of several files."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.recurrence import SessionPort


class AnySession(Protocol):
    """A model that is ready to run, in however many files it comes."""

    @property
    def provider(self) -> Provider:
        """What runs it."""
        ...

    @property
    def inputs(self) -> Mapping[str, SessionPort]:
        """By name, what must be fed, in order."""
        ...

    @property
    def outputs(self) -> Mapping[str, SessionPort]:
        """By name, what comes out, in order."""
        ...

    @property
    def metadata(self) -> Mapping[str, str]:
        """The model's own metadata."""
        ...

    @property
    def recurrent(self) -> Mapping[str, str]:
        """``{input: output}`` of the state that is fed forward."""
        ...

    def first_state(self, held: Mapping[str, Array]) -> dict[str, Array]:
        """Return what the recurrent inputs hold where a scene begins.

        Args:
            held: what a frame says of them; it wins.

        Raises:
            GraphError: an input of unknown shape has no first value.
        """
        ...

    def run(
        self,
        feeds: Mapping[str, Array],
        outputs: Sequence[str] | None = None,
        *,
        first: bool = False,
    ) -> dict[str, Array]:
        """Run once.

        Args:
            feeds: one array for every input; other names are ignored.
            outputs: which to return; None for all.
            first: whether a scene begins here; it decides which files of a stack run.

        Raises:
            FramesError: an input is missing, or has not the type or shape it must.
            GraphError: a node failed on these inputs.
        """
        ...
