"""How much room the disks have that this process writes to."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import url2pathname

if TYPE_CHECKING:
    from worker.settings import Settings


class Disk:
    """The disks of a local storage and of the scratch folder, and what is to be left free of them.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self.reserve = settings.min_free_bytes
        storage = urlsplit(settings.objects_url)
        local = [url2pathname(storage.path)] if storage.scheme == "file" else []
        self._folders = [*local, str(settings.scratch)]

    def free(self) -> int | None:
        """Return the bytes that are free on the fullest disk; None where no folder is here."""
        found = []
        for folder in self._folders:
            try:
                found.append(shutil.disk_usage(folder).free)
            except OSError:  # scratch is the workers', who may be elsewhere
                continue
        return min(found, default=None)

    def has_room(self, size: int = 0) -> bool:
        """Whether the reserve stays free when some bytes more are written."""
        if self.reserve == 0:
            return True
        free = self.free()
        return free is None or free - size >= self.reserve
