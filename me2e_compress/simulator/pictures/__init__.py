"""Pictures of a driven route: one moment, a strip of moments, an animation."""

from me2e_compress.simulator.pictures.route import (
    Moment,
    RoutePicture,
    write_gif,
    write_png,
)

__all__ = ["Moment", "RoutePicture", "write_gif", "write_png"]
