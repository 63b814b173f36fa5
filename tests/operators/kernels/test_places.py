"""Where compiled code is kept, and what is done where that is not possible."""

import ctypes
import os
from pathlib import Path

import pytest

from me2e_compress.operators import kernels
from me2e_compress.operators.kernels import trampoline
from tests.operators.kernels import needs_kernels


def test_the_folder_is_this_users_alone(tmp_path: Path) -> None:
    folder = tmp_path / "cache" / "kernels"

    assert trampoline.private(folder) == folder
    assert folder.stat().st_mode & 0o777 == 0o700

    folder.chmod(0o777)
    assert trampoline.private(folder) is None


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_the_shared_object_is_small(machine: str) -> None:
    content = trampoline.shared_object(machine)

    assert content.startswith(b"\x7fELF\2\1\1")
    assert len(content) == {"x86_64": 0x1108, "aarch64": 0x10108}[machine]


@needs_kernels
def test_the_shared_object_is_written_and_opened(tmp_path: Path) -> None:
    opened = trampoline.load(tmp_path / "kernels")

    assert Path(opened.path).parent == tmp_path / "kernels"
    add = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    assert add(opened.address("CreateKernel"))(4096) == 4096 + trampoline.STATE_OFFSET


@needs_kernels
def test_no_writable_cache(tmp_path: Path) -> None:
    (tmp_path / "kernels").write_text("in the way")

    opened = trampoline.load(tmp_path / "kernels")

    assert opened.path.startswith("/proc/self/fd/")
    assert opened.address("KernelDestroy")


@needs_kernels
def test_a_cache_mounted_noexec(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = ctypes.CDLL

    def strict(path: str) -> ctypes.CDLL:
        if path.startswith(str(tmp_path)):
            raise OSError("failed to map segment from shared object")
        return real(path)

    monkeypatch.setattr(ctypes, "CDLL", strict)

    assert trampoline.load(tmp_path).path.startswith("/proc/self/fd/")


@needs_kernels
def test_code_is_compiled_once_and_read_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from me2e_compress.operators.kernels import custom_ops

    code = kernels.KERNELS[0]
    folder = trampoline.default_folder()
    custom_ops.load_or_compile(code, folder)
    file = folder / f"{code.op_type}-{custom_ops._fingerprint()}.o"
    if not file.is_file():
        pytest.skip("the user's cache folder keeps nothing")
    made = file.read_bytes()[custom_ops._DIGEST :]
    compiled: list[object] = []

    def counted(functions: object) -> bytes:
        compiled.append(functions)
        return made

    monkeypatch.setattr(custom_ops, "_compiled", counted)

    def load() -> int:
        custom_ops.load_or_compile(code, tmp_path)
        return len(compiled)

    assert load() == 1
    assert load() == 1
    (kept,) = tmp_path.iterdir()
    assert kept.stat().st_mode & 0o777 == 0o600
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    assert load() == 1
    custom_ops.load_or_compile(code, blocked)
    assert len(compiled) == 2  # nowhere to keep it: compiled in every process
    os.truncate(kept, kept.stat().st_size // 2)  # a disk that was full
    assert load() == 3
