"""A bounded queue between the reading thread and the mapping thread. A full queue drops its oldest items."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")

CAPACITY = 512
"""Items (scans); about 48 s of the paper's ring."""
MAX_TOTAL_SIZE = 1 << 22
"""Echoes of all scans in the queue; about 100 MB."""


class DropOldestQueue(Generic[Item]):
    """First in, first out. A full queue drops its oldest item for a new one, and counts it.

    For steering a robot, new scans are worth more than old ones. A producer that can wait (a file) passes ``wait`` to
    ``put`` instead.
    """

    def __init__(
        self,
        capacity: int = CAPACITY,
        *,
        size_of: Callable[[Item], int] | None = None,
        max_total_size: int = MAX_TOTAL_SIZE,
    ):
        """An open, empty queue.

        Args:
            capacity: maximum number of items, at least 1.
            size_of: size of an item; None: only the number of items is limited.
            max_total_size: maximum sum of the sizes of all items. A single item may be larger.
        """
        self._items: deque[Item] = deque()
        self.capacity = max(1, capacity)
        """Maximum number of items. Lowering it keeps the items that are in the queue."""
        self._size_of, self._max_total_size, self._total_size = size_of, max_total_size, 0
        self._changed = threading.Condition()
        self._closed = False
        self._error: BaseException | None = None
        self.dropped = 0
        """Number of items dropped for newer ones."""

    def put(self, item: Item, *, wait: threading.Event | None = None) -> None:
        """Append an item. After ``close`` it is discarded.

        Args:
            item: the item.
            wait: if given, wait for free space instead of dropping, until this event is set.
        """
        size = self._item_size(item)
        with self._changed:
            while wait is not None and self._is_full(size) and not (wait.is_set() or self._closed):
                self._changed.wait(0.1)
            if self._closed:
                return
            if len(self._items) >= self.capacity:
                self._pop()
                self.dropped += 1
            while self._items and self._total_size + size > self._max_total_size:
                self._pop()
                self.dropped += 1
            self._items.append(item)
            self._total_size += size
            self._changed.notify_all()

    def get(self, timeout: float, *, max_items: int = 1) -> list[Item]:
        """Remove and return the oldest items, as soon as there is one.

        Args:
            timeout: seconds to wait for the first item.
            max_items: maximum number of items; only the first one is waited for.

        Returns:
            At least one item; an empty list after the timeout, or when the queue is closed and empty.

        Raises:
            BaseException: the error passed to ``close``, once, after all earlier items were returned.
        """
        deadline = time.monotonic() + timeout
        with self._changed:
            while not self._items and not self._closed and (left := deadline - time.monotonic()) > 0:
                self._changed.wait(left)
            taken = [self._pop() for _ in range(min(max_items, len(self._items)))]
            if not taken and self._error is not None:
                error, self._error = self._error, None
                raise error
            self._changed.notify_all()
            return taken

    def close(self, error: BaseException | None = None) -> None:
        """Accept no more items. Items in the queue can still be taken.

        Args:
            error: the cause, if the stream failed; ``get`` raises it in the consumer.
        """
        with self._changed:
            self._error = self._error or error
            self._closed = True
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """The queue is closed, empty, and its error (if any) was raised."""
        with self._changed:
            return self._closed and not self._items and self._error is None

    def __len__(self) -> int:
        return len(self._items)

    def _item_size(self, item: Item) -> int:
        return 0 if self._size_of is None else self._size_of(item)

    def _is_full(self, size: int) -> bool:
        """Whether an item of this size does not fit."""
        return len(self._items) >= self.capacity or bool(self._items and self._total_size + size > self._max_total_size)

    def _pop(self) -> Item:
        item = self._items.popleft()
        self._total_size -= self._item_size(item)
        return item
