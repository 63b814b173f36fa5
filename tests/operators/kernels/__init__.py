import pytest

from me2e_compress.operators import kernels

WHY_NOT = str(kernels.why_not())
needs_kernels = pytest.mark.skipif(kernels.why_not() is not None, reason=WHY_NOT)
