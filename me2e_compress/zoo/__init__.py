"""The reference stacks in torch, their exporters and their synthetic frames.

Importing this needs no torch; using an exporter does (extra ``zoo``).
"""

from me2e_compress.zoo.stacks import STACKS, Stack

__all__ = ["STACKS", "Stack"]
