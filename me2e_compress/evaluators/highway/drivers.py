"""The driver of an ONNX file.

A driver imports its simulator or runtime only when it is opened.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import DEFAULT_IMAGE_SIZE, Policy
from me2e_compress.driving.host_stage import HOST_STAGES, HostStage
from me2e_compress.driving.policies import POLICIES, Driver, SizedPolicy
from me2e_compress.driving.shipped_adapters import adapter_file, shipped_adapters
from me2e_compress.graph import load, sha256_of
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.runtime.providers import CPU, Provider


@dataclass(frozen=True)
class OnnxDriver(Driver):
    """An ONNX file that keeps the policy contract.

    Attributes:
        path: The file.
        adapter: TOML file that adapts the model to the contract, or the name of one
            that ships; None where the model keeps it as it is.
        module_map: Preset or TOML file that says which output is the plan and which are
            fed back; None leaves that to the model.
        provider: What runs it; as a text ``cpu``, ``tensorrt{cache=engines}``.
        host_stage: Changes the plan on the host, as a text ``collision-optimizer``;
            None leaves it as the network has it.
    """

    name: ClassVar[str] = "onnx"
    path: Path
    adapter: Path | None = None
    module_map: str | None = None
    provider: Provider = CPU
    host_stage: HostStage | None = None

    def __post_init__(self) -> None:
        if self.adapter is not None and str(self.adapter) in shipped_adapters():
            object.__setattr__(self, "adapter", adapter_file(self.adapter))

    def open(self) -> Policy:
        """Return the policy; open files and provider."""
        from me2e_compress.driving.adapter import Adapter
        from me2e_compress.driving.onnx_policy import OnnxPolicy

        if not self.path.is_file():
            raise EvaluationError(
                f"policy {self.path}: no such file, and no policy of that name; there"
                f" are {', '.join(POLICIES.names())}"
            )
        adapter = None if self.adapter is None else Adapter.load(self.adapter)
        stage, metadata = self.host_stage, self.metadata()
        return OnnxPolicy.open(self.path, adapter, self.provider, stage, metadata)

    def metadata(self) -> dict[str, str]:
        """Return what the map says, as metadata of the graph."""
        from me2e_compress.driving.adapter.outputs import write_port_metadata

        if self.module_map is None:
            return {}
        return write_port_metadata(load(self.path), None, self.module_map)

    @property
    def label(self) -> str:
        """Stem of the file name."""
        return self.path.stem

    def fingerprint(self) -> str:
        """Return the digests of its files, with provider and host stage."""
        digests = [sha256_of(self.path)]
        if self.adapter is not None:
            digests.append(sha256_of(self.adapter))
        if self.module_map is not None:
            digests.append(repr(ModuleMap.load(self.module_map)))
        if self.provider != CPU:
            digests.append(str(self.provider))
        if self.host_stage is not None:
            digests.append(HOST_STAGES.text(self.host_stage, defaults=True))
        return "+".join(digests)


def image_size_of(policy: Policy) -> tuple[int, int]:
    """Return rows and columns of the images that a policy wants."""
    return policy.image_size if isinstance(policy, SizedPolicy) else DEFAULT_IMAGE_SIZE
