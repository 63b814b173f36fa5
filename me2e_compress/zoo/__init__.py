"""The reference stacks in torch, their exporters and their synthetic frames.

The package imports without torch; exporters need it (extra ``zoo``).
"""

from me2e_compress.zoo.stacks import STACKS, Stack

__all__ = ["STACKS", "Stack"]
