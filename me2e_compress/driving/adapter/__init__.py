"""How a model with its own names and layouts is adapted to the policy contract."""

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.image_inputs import ImageNormalization
from me2e_compress.driving.input_sources import Axes

__all__ = ["Adapter", "Axes", "ImageNormalization"]
