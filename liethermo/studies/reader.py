"""Reading of a store by the ``zarr`` package, with an error where it would replace missing chunks by fill values."""

from __future__ import annotations

from typing import Any

import zarr

from .store import StudyStore


class CheckedZarrReader(zarr.storage.LocalStore):
    """Zarr store that checks each chunk before it is read.

    Parameters
    ----------
    study_store : StudyStore
    owner : object
        Kept alive as long as this reader, for example a temporary folder.
    """

    def __init__(self, study_store: StudyStore, owner: object = None):
        super().__init__(study_store.root, read_only=True)
        self.study_store, self.owner = study_store, owner

    def with_read_only(self, read_only: bool = False) -> CheckedZarrReader:
        """Return this reader, which is always read-only."""
        return self

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """Return the content of a file of the store; raise FileError if the file is damaged, or missing from a finished
        chunk."""
        name, chunk_separator, index = key.partition("/c/")
        if chunk_separator and name in self.study_store.arrays:
            self.study_store.check_chunk_file(name, tuple(map(int, index.split("/"))))
        return await super().get(key, prototype, byte_range)
