"""Pools of sheltered processes that end with the block that opened them."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import active_children

from me2e_compress.runtime.children import end_with_parent, spawn_context


@contextlib.contextmanager
def kill_on_error() -> Iterator[None]:
    """Kill the processes that were started in this block if it raises."""
    others = set(active_children())
    try:
        yield
    except BaseException:
        for child in set(active_children()) - others:
            child.kill()
        raise


@contextlib.contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Open a pool of so many processes, which end with this block in every case."""
    executor = ProcessPoolExecutor(workers, spawn_context(), end_with_parent)
    try:
        with kill_on_error():
            yield executor
    finally:
        executor.shutdown(cancel_futures=True)
