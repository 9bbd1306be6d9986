"""Hands the latest state and picture to every page that is open; slow pages skip some."""

import asyncio
from dataclasses import dataclass, field

# Pictures on their way to a page that has not yet shown them: one being drawn, one being sent.
_ON_THE_WAY = 2


@dataclass(slots=True, eq=False)
class Watcher:
    """One page.

    Attributes
    ----------
    may_command : bool
    unshown : int
        Pictures that were sent and not yet shown.
    gone : Event
        Set when another page takes this one's place.
    """

    may_command: bool
    unshown: int = 0
    gone: asyncio.Event = field(default_factory=asyncio.Event)
    _state: str | None = None
    _picture: bytes | None = None
    _news: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, state: str, picture: bytes | None) -> None:
        """Leave the latest; what has not been sent is replaced."""
        self._state = state
        self._picture = picture if picture is not None else self._picture
        self._news.set()

    def shown(self) -> None:
        """Note that the page can take one picture more."""
        self.unshown = max(0, self.unshown - 1)
        self._news.set()

    async def next(self) -> tuple[str | None, bytes | None]:
        """Wait for news; returns a state and, where the page keeps up, a picture."""
        while True:
            await self._news.wait()
            self._news.clear()
            state, self._state = self._state, None
            picture = None
            if self._picture is not None and self.unshown < _ON_THE_WAY:
                picture, self._picture = self._picture, None
                self.unshown += 1
            if state is not None or picture is not None:
                return state, picture


class Hub:
    """All pages; used from the server's event loop alone, but for `n_watchers`."""

    MAX_WATCHERS = 8

    def __init__(self) -> None:
        # In the order in which they came.
        self._watchers: dict[Watcher, None] = {}

    @property
    def n_watchers(self) -> int:
        """Pages that are open."""
        return len(self._watchers)

    def join(self, watcher: Watcher) -> bool:
        """Add a page; False if there are too many.

        A page that may command takes the place of the oldest one that may not.
        """
        if len(self._watchers) >= self.MAX_WATCHERS:
            oldest = next((one for one in self._watchers if not one.may_command), None)
            if oldest is None or not watcher.may_command:
                return False
            self.leave(oldest)
            oldest.gone.set()
        self._watchers[watcher] = None
        return True

    def leave(self, watcher: Watcher) -> None:
        """Remove a page."""
        self._watchers.pop(watcher, None)

    def publish(self, state: str, picture: bytes | None) -> None:
        """Hand out the latest state, and picture if there is a new one."""
        for watcher in self._watchers:
            watcher.put(state, picture)
