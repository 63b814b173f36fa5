"""Pictures of a driven route: one moment, a strip of moments, an animation."""

from me2e_compress.simulator.pictures.files import write_gif, write_png
from me2e_compress.simulator.pictures.route import Moment, RoutePicture

__all__ = ["Moment", "RoutePicture", "write_gif", "write_png"]
