"""The driver that ships, as a policy by its name."""

from dataclasses import dataclass
from typing import ClassVar

from me2e_compress.driving.contract import Policy
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.zoo.shipped import shipped


@dataclass(frozen=True)
class ShippedDriver(Driver):
    """The trained driver that comes with the package."""

    name: ClassVar[str] = "highway"

    def resolved(self) -> Driver:
        """Return the ONNX file that it is.

        Raises:
            GraphError: The file is missing or altered.
        """
        return OnnxDriver(shipped(self.name))

    def open(self) -> Policy:
        """Return the policy."""
        return self.resolved().open()

    def fingerprint(self) -> str:
        """Return the digest of the file: results of either are the same."""
        return self.resolved().fingerprint()
