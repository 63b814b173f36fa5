"""Pictures of a driven route: a moment, a strip, an animation, two drives at once."""

from me2e_compress.simulator.pictures.route import (
    Moment,
    RoutePicture,
    overlay,
    write_gif,
    write_png,
)

__all__ = ["Moment", "RoutePicture", "overlay", "write_gif", "write_png"]
