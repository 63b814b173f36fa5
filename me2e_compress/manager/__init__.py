"""Run passes in order, each as a transaction, and keep the books."""

from me2e_compress.manager.pass_manager import PassManager
from me2e_compress.manager.report import Report, Step, Verification

__all__ = ["PassManager", "Report", "Step", "Verification"]
