"""The driver that ships, as a policy by its name."""

from dataclasses import dataclass
from typing import ClassVar

from me2e_compress.driving.contract import Policy
from me2e_compress.driving.host_stage import HostStage
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.shipped.drivers import shipped_model


@dataclass(frozen=True)
class ShippedDriver(Driver):
    """The trained driver that comes with the package.

    Attributes:
        host_stage: changes the plan on the host, as a text ``collision-optimizer``;
            None leaves it as the network has it.
    """

    name: ClassVar[str] = "highway"
    host_stage: HostStage | None = None

    def resolved(self) -> Driver:
        """Return the driver of the shipped ONNX file."""
        return OnnxDriver(shipped_model(self.name), host_stage=self.host_stage)

    def open(self) -> Policy:
        """Return the policy."""
        return self.resolved().open()

    def fingerprint(self) -> str:
        """Return the digest of the file: results under either name are the same."""
        return self.resolved().fingerprint()
