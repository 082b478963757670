"""Protocol for the storage of a campaign, and storage in memory."""

import threading
from typing import Protocol

from trustbo.campaign.state import Entry, State


class Storage(Protocol):
    """Storage of a campaign.

    Attributes:
        turn: Lock between threads, held during each operation of the campaign.
    """

    turn: threading.RLock

    def require_open(self) -> None:
        """Raise TrustboError if nothing can be recorded, for example after `close`."""
        ...

    def add_mission(self, n: int, entry: Entry) -> None:
        """Record mission n, counted from 1; after a TrustboError, it is not recorded."""
        ...

    def write(self, state: State) -> None:
        """Record everything else; after a TrustboError, the earlier record is unchanged."""
        ...

    def close(self) -> None:
        """Release the storage; if others can use it too, it is not written any more."""
        ...


class MemoryStorage:
    """Storage of a campaign that exists in memory only: its state is all there is to record."""

    def __init__(self) -> None:
        self.turn = threading.RLock()

    def require_open(self) -> None:
        """Do nothing; it is always open."""

    def add_mission(self, n: int, entry: Entry) -> None:
        """Do nothing."""

    def write(self, state: State) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing; the campaign can go on."""
