"""The interface of a runnable model: a graph, or a stack of several files."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from me2e_compress.graph.recurrence import SessionPort
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import Provider


class AnySession(Protocol):
    """A model that is ready to run, stored in one file or several."""

    @property
    def provider(self) -> Provider:
        """The execution provider that runs the model."""
        ...

    @property
    def inputs(self) -> Mapping[str, SessionPort]:
        """The inputs by name, in order."""
        ...

    @property
    def outputs(self) -> Mapping[str, SessionPort]:
        """The outputs by name, in order."""
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
        """Return the recurrent inputs for the start of a scene; ``held`` comes first.

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
        """Run one inference; return all outputs, or those that are named.

        ``feeds`` has one array for every input; other names are ignored. Which files of
        a stack run depends on whether a scene begins here, ``first``.

        Raises:
            FramesError: an input is missing or has the wrong type or shape.
            GraphError: a node failed on these inputs.
        """
        ...
