"""Blocks of consecutive frames, and a thread that reads them ahead."""

import contextlib
import queue
import threading
from collections.abc import Iterator
from typing import TypeVar

from aqualvs.errors import AqualvsError

T = TypeVar("T")

_MOST_FRAMES = 8
_MOST_BYTES = 32 << 20
_PATIENCE_S = 0.1


def block_length(size_px: tuple[int, int]) -> int:
    """Return how many frames make a block: a few, and less than 32 MB.

    Measuring eight frames step by step takes a third less than one after the other, between which
    the decoder displaces all code from the caches; more than eight gain nothing.
    """
    n_bytes = 3 * size_px[0] * size_px[1] // 2
    return max(1, min(_MOST_FRAMES, _MOST_BYTES // n_bytes))


def in_blocks(
    items: Iterator[T], length: int, breaks: type[Exception] = AqualvsError
) -> Iterator[list[T]]:
    """Yield lists of up to `length` items; none is lost where their source breaks off.

    Parameters
    ----------
    items : iterator
    length : int
    breaks : type of exception
        How it breaks off; raised after the items before it.
    """
    block: list[T] = []
    try:
        for item in items:
            block.append(item)
            if len(block) == length:
                yield block
                block = []
    except breaks:
        if block:
            yield block
        raise
    if block:
        yield block


def read_ahead(items: Iterator[T]) -> Iterator[T]:
    """Yield items that a thread fetches, up to two of them before they are wanted.

    An exception of `items` is raised where it belongs in the order. When the iteration is given up,
    the thread ends after the item that it is fetching.
    """
    fetched: queue.Queue[T | _End] = queue.Queue(1)
    given_up = threading.Event()

    def put(item: T | _End) -> None:
        while not given_up.is_set():
            with contextlib.suppress(queue.Full):
                return fetched.put(item, timeout=_PATIENCE_S)
        return None

    def fetch() -> None:
        try:
            for item in items:
                put(item)
                if given_up.is_set():
                    return
            put(_End())
        except BaseException as fault:  # raised again where it is noticed
            put(_End(fault))

    thread = threading.Thread(target=fetch, name="frames", daemon=True)
    thread.start()
    try:
        while not isinstance(item := fetched.get(), _End):
            yield item
        if item.fault is not None:
            raise item.fault
    finally:
        given_up.set()
        thread.join()


class _End:
    """Stands for the end of the items, and what brought it about."""

    def __init__(self, fault: BaseException | None = None) -> None:
        self.fault = fault
