"""Energy of a model, either measured by a device counter or modelled."""

from me2e_compress.runtime.energy.energy_result import EnergyResult

__all__ = ["EnergyResult"]
