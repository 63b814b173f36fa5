"""What an input of a graph is fed from, or what an output is used as."""

from dataclasses import dataclass

from me2e_compress.driving.ports import Shape


@dataclass(frozen=True)
class PortUse:
    """One input or output of a graph, and its part in driving.

    Attributes:
        name: Of the port.
        shape: As the graph declares it.
        type: Its element type, ``float`` or ``int64``.
        use: What an input is fed, or what an output is read as; None is nothing.
        problem: Why the model cannot drive so; empty where it can.
    """

    name: str
    shape: Shape
    type: str
    use: str | None
    problem: str = ""


def element_type(of_port: str) -> str:
    """Return ``int64`` of ``tensor(int64)``."""
    return of_port.removeprefix("tensor(").removesuffix(")")
