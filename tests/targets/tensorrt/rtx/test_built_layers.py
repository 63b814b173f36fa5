from me2e_compress.targets.tensorrt.rtx_check import Kernel, read_kernels, without_int8

PLAN = (
    b'\x00\x01 t={ name="in" shape={ 1 3 } type=int8 } t={ name="w" type=int8 }'
    b' t={ name="f" type=float }'
    b' corrltn={ name="/a/Conv" output={"o" } input={"in" "w" } pad={ 1 } }'
    b' fully_connected={ name="/q/MatMul+/k/MatMul" output={"o" } input={"f" "w" } }'
    b' corrltn={ name="/b/Conv" output={"o" } input={"lost" "w" } }\xff'
)


def test_kernels_are_read_off_the_text_of_a_plan() -> None:
    assert read_kernels(PLAN) == (
        Kernel("convolution", ("/a/Conv",), ("int8", "int8")),
        Kernel("product", ("/q/MatMul", "/k/MatMul"), ("float", "int8")),
        Kernel("convolution", ("/b/Conv",), ("?", "int8")),
    )


def test_nodes_without_an_int8_kernel_are_named() -> None:
    nodes = ("/a/Conv", "/b/Conv", "/k/MatMul", "/c/Conv")

    assert without_int8(nodes, read_kernels(PLAN)) == (
        "/b/Conv",
        "/k/MatMul",
        "/c/Conv",
    )
