"""An input of a graph with its feed, or an output with its use."""

from dataclasses import dataclass

from me2e_compress.driving.ports import Shape


@dataclass(frozen=True)
class PortUse:
    """One input or output of a graph, and its part in driving.

    Attributes:
        use: its feed, or how it is read; None for nothing.
        problem: why the model cannot drive so; empty where it can.
    """

    name: str
    shape: Shape
    type: str
    use: str | None
    problem: str = ""


def element_type(of_port: str) -> str:
    """Return ``int64`` of ``tensor(int64)``."""
    return of_port.removeprefix("tensor(").removesuffix(")")
