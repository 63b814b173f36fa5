"""Pictures of a driven route: one moment, a strip of moments, an animation."""

from me2e_compress.evaluators.highway.picture.files import write_gif, write_png
from me2e_compress.evaluators.highway.picture.route import Moment, RoutePicture

__all__ = ["Moment", "RoutePicture", "write_gif", "write_png"]
