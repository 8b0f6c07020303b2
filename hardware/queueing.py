"""A bounded queue between the thread that reads a device and the one that makes maps: the newest win."""

import threading
import time
from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")

CAPACITY = 512
"""Scans, about 48 s of the paper's ring."""


class NewestQueue(Generic[Item]):
    """First in, first out. Where it is full, the oldest item makes room for the newest, and is counted.

    Old scans are worth less than new ones to whoever steers a robot. A source that can wait (a file) asks ``put`` to.
    """

    def __init__(self, capacity: int = CAPACITY):
        """An open, empty queue.

        Args:
            capacity: items it holds, at least 1.
        """
        self._items: deque[Item] = deque()
        self.capacity = max(1, capacity)
        """Items it holds; what is there stays when it becomes less."""
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
        with self._changed:
            while wait is not None and len(self._items) >= self.capacity and not (wait.is_set() or self._closed):
                self._changed.wait(0.1)
            if self._closed:
                return
            if len(self._items) >= self.capacity:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
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
            taken = [self._items.popleft() for _ in range(min(most, len(self._items)))]
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
