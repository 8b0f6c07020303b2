"""A bounded queue between the thread that reads a device and the one that makes maps: the newest win."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")

CAPACITY = 512
"""Scans, about 48 s of the paper's ring."""
ROOM = 1 << 22
"""Echoes of all scans in the queue, some 100 MB."""


class NewestQueue(Generic[Item]):
    """First in, first out. Where it is full, the oldest item makes room for the newest, and is counted.

    Old scans are worth less than new ones to whoever steers a robot. A source that can wait (a file) asks ``put`` to.
    """

    def __init__(self, capacity: int = CAPACITY, *, size: Callable[[Item], int] | None = None, room: int = ROOM):
        """An open, empty queue.

        Args:
            capacity: items it holds, at least 1.
            size: of an item; None: only their number counts.
            room: what the sizes of all items may add up to; a single one may be larger.
        """
        self._items: deque[Item] = deque()
        self.capacity = max(1, capacity)
        """Items it holds; what is there stays when it becomes less."""
        self._size, self._room, self._used = size, room, 0
        self._changed = threading.Condition()
        self._closed = False
        self._error: BaseException | None = None
        self.dropped = 0
        """Items that made room for newer ones."""

    def put(self, item: Item, *, wait: threading.Event | None = None) -> None:
        """Add an item; after ``close`` it goes nowhere.

        Args:
            item: to add.
            wait: wait for room instead of dropping, until this event is set.
        """
        size = self._size_of(item)
        with self._changed:
            while wait is not None and self._is_full(size) and not (wait.is_set() or self._closed):
                self._changed.wait(0.1)
            if self._closed:
                return
            if len(self._items) >= self.capacity:
                self._take()
                self.dropped += 1
            while self._items and self._used + size > self._room:
                self._take()
                self.dropped += 1
            self._items.append(item)
            self._used += size
            self._changed.notify_all()

    def get(self, timeout: float, *, most: int = 1) -> list[Item]:
        """The oldest items, as soon as there is one.

        Args:
            timeout: seconds to wait for the first.
            most: items to take at once, those that are there.

        Returns:
            At least one item, or none when the time is over or the queue was closed and is empty.

        Raises:
            BaseException: what ``close`` was given, once, after everything before it was taken.
        """
        deadline = time.monotonic() + timeout
        with self._changed:
            while not self._items and not self._closed and (left := deadline - time.monotonic()) > 0:
                self._changed.wait(left)
            taken = [self._take() for _ in range(min(most, len(self._items)))]
            if not taken and self._error is not None:
                error, self._error = self._error, None
                raise error
            self._changed.notify_all()
            return taken

    def close(self, error: BaseException | None = None) -> None:
        """No more items will come; what is in the queue can still be taken.

        Args:
            error: why, if it was not in order; the consumer gets it.
        """
        with self._changed:
            self._error = self._error or error
            self._closed = True
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """Closed, and everything was taken, an error too."""
        with self._changed:
            return self._closed and not self._items and self._error is None

    def __len__(self) -> int:
        return len(self._items)

    def _size_of(self, item: Item) -> int:
        return 0 if self._size is None else self._size(item)

    def _is_full(self, size: int) -> bool:
        """Whether an item of this size has no room."""
        return len(self._items) >= self.capacity or bool(self._items and self._used + size > self._room)

    def _take(self) -> Item:
        item = self._items.popleft()
        self._used -= self._size_of(item)
        return item
