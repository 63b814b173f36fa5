"""Energy of a model, measured by a counter of the device."""

from me2e_compress.runtime.energy.energy_result import EnergyResult

__all__ = ["EnergyResult"]
