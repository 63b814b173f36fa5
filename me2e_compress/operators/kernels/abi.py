"""Constants shared by Python, compiled kernels and onnxruntime's C interface.

Offsets in ``OrtApi`` and ``OrtCustomOp`` are those of ``onnxruntime_c_api.h``, where
entries are only ever added at the end. Numba is not imported here: kernels that a
machine has compiled run without it.
"""

API_VERSION = 17
"""The first with ``KernelContext_ParallelFor``: onnxruntime 1.17."""

OP_VERSION = 16
"""The first with ``KernelComputeV2``, which returns a status."""

CREATE_DOMAIN, ADD_OP, ADD_DOMAIN, CREATE_MEMORY = 26, 27, 28, 69

CALLED_BY_KERNELS = (
    0,  # CreateStatus
    90,  # KernelContext_GetInput
    91,  # KernelContext_GetOutput
    51,  # GetTensorMutableData
    65,  # GetTensorTypeAndShape
    60,  # GetTensorElementType
    61,  # GetDimensionsCount
    62,  # GetDimensions
    99,  # ReleaseTensorTypeAndShapeInfo
    274,  # KernelContext_ParallelFor
    253,  # KernelContext_GetAllocator
    75,  # AllocatorAlloc
    76,  # AllocatorFree
    132,  # ReleaseAllocator
)
(
    CREATE_STATUS,
    GET_INPUT,
    GET_OUTPUT,
    GET_DATA,
    GET_INFO,
    GET_TYPE,
    GET_RANK,
    GET_DIMS,
    RELEASE_INFO,
    PARALLEL_FOR,
    GET_ALLOCATOR,
    ALLOCATE,
    FREE,
    RELEASE_ALLOCATOR,
) = range(len(CALLED_BY_KERNELS))
"""Words of a kernel's state: the addresses of those functions, then"""
BLOCK = len(CALLED_BY_KERNELS)
"""the address of the kernel's own ``block``, which ``ParallelFor`` calls, then"""
MEMORY = BLOCK + 1
"""what describes the memory of the CPU, then"""
MESSAGES = MEMORY + 1
"""the addresses of its error messages."""
STATE_WORDS = MESSAGES + 16

ARENA, DEFAULT = 1, 0
"""``OrtArenaAllocator`` and ``OrtMemTypeDefault``."""

INVALID_ARGUMENT = 2
"""``ORT_INVALID_ARGUMENT``."""

FLOAT, UINT8, INT8, INT32, INT64, ANY = 1, 2, 3, 6, 7, 0
"""``ONNXTensorElementDataType``; ``ANY`` leaves the check to the kernel."""

VARIADIC = (
    "GetVariadicInputMinArity",
    "GetVariadicInputHomogeneity",
    "GetVariadicOutputMinArity",
    "GetVariadicOutputHomogeneity",
)
CHARACTERISTICS = (
    "GetInputCharacteristic",
    "GetOutputCharacteristic",
    "GetInputMemoryType",
)
FIELDS = (
    "version",
    "CreateKernel",
    "GetName",
    "GetExecutionProviderType",
    "GetInputType",
    "GetInputTypeCount",
    "GetOutputType",
    "GetOutputTypeCount",
    "KernelCompute",
    "KernelDestroy",
    *CHARACTERISTICS,
    *VARIADIC,
    "CreateKernelV2",
    "KernelComputeV2",
)
"""Fields of ``OrtCustomOp``, one word each; the fields after them are newer."""


ADDRESS, TYPE, EACH = 8, 9, 10
"""Ten words an input: eight dimensions, address and element type."""
