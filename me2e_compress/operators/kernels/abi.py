"""Constants shared by Python, compiled kernels and onnxruntime's C interface.

Offsets in ``OrtApi`` and ``OrtCustomOp`` are those of ``onnxruntime_c_api.h``, where
entries are only ever added at the end. Numba is not imported here: kernels that a
machine has compiled run without it.
"""

API_VERSION = 17  # the first with `KernelContext_ParallelFor`: onnxruntime 1.17
OP_VERSION = 16  # the first with `KernelComputeV2`, which returns a status

# Functions of `OrtApi` by offset: those that Python calls, and those of kernels
CREATE_DOMAIN, ADD_OP, ADD_DOMAIN = 26, 27, 28
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
)

# Words of a kernel's state: the addresses of those functions, that of its own `block`,
# which `ParallelFor` calls, and the addresses of up to 16 error messages
CREATE_STATUS, GET_INPUT, GET_OUTPUT, GET_DATA, GET_INFO, GET_TYPE = range(6)
GET_RANK, GET_DIMS, RELEASE_INFO, PARALLEL_FOR, BLOCK, MESSAGES = range(6, 12)
STATE_WORDS = MESSAGES + 16

INVALID_ARGUMENT = 2  # `ORT_INVALID_ARGUMENT`

# `ONNXTensorElementDataType`; `ANY` leaves the check to the kernel
FLOAT, UINT8, INT8, INT32, INT64, ANY = 1, 2, 3, 6, 7, 0

# Fields of `OrtCustomOp`, one word each; the fields after them are newer
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

# Words of an input: eight dimensions, then address and element type; EACH in all
ADDRESS, TYPE, EACH = 8, 9, 10

# Words of a tensor in the context of a call inside OpenVINO, whose output comes first
TYPE_OF, RANK, DIMENSIONS = range(1, 4)
TENSOR = DIMENSIONS + ADDRESS
# Names of the first words of a state, which are addresses of functions
HOST_FUNCTIONS = (
    "CREATE_STATUS", "GET_INPUT", "GET_OUTPUT", "GET_DATA", "GET_INFO", "GET_TYPE",
    "GET_RANK", "GET_DIMS", "RELEASE_INFO", "PARALLEL_FOR",
)  # fmt: skip
