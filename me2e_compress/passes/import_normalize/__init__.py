"""The pass that makes a graph from anywhere one that the other passes can work on."""

from me2e_compress.passes.import_normalize.normalize import ImportNormalize
from me2e_compress.passes.import_normalize.plugins import ORIGINAL_DOMAIN, PLUGIN_DOMAIN

__all__ = ["ORIGINAL_DOMAIN", "PLUGIN_DOMAIN", "ImportNormalize"]
