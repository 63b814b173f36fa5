"""The part of TensorRT-RTX 1.7 that is used: the package has no types of its own."""

from enum import IntEnum

__version__: str

class ILogger:
    class Severity(IntEnum):
        INTERNAL_ERROR = 0
        ERROR = 1
        WARNING = 2
        INFO = 3
        VERBOSE = 4

    def __init__(self) -> None: ...
    def log(self, severity: Severity, message: str) -> None: ...

class ComputeCapability(IntEnum):
    NONE = 0

class INetworkDefinition:
    num_layers: int

class IHostMemory(bytes): ...

class IBuilderConfig:
    num_compute_capabilities: int
    def set_compute_capability(self, which: ComputeCapability, index: int) -> bool: ...

class Builder:
    def __init__(self, logger: ILogger) -> None: ...
    def create_network(self, flags: int) -> INetworkDefinition: ...
    def create_builder_config(self) -> IBuilderConfig: ...
    def build_serialized_network(
        self, network: INetworkDefinition, config: IBuilderConfig
    ) -> IHostMemory | None: ...

class ParserError:
    def node_name(self) -> str: ...
    def node_operator(self) -> str: ...
    def desc(self) -> str: ...

class OnnxParser:
    num_errors: int
    def __init__(self, network: INetworkDefinition, logger: ILogger) -> None: ...
    def parse_from_file(self, path: str) -> bool: ...
    def get_error(self, index: int) -> ParserError: ...
