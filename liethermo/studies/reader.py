"""A store as the ``zarr`` package reads it, which takes what is missing for fill values: here that is an error."""

from __future__ import annotations

from typing import Any

import zarr

from .store import StudyStore


class CheckedZarrReader(zarr.storage.LocalStore):
    """The files of a store, each chunk with its checksum.

    Parameters
    ----------
    study_store : Store
    owner : object
        Lives as long as this does.
    """

    def __init__(self, kept: StudyStore, owner: object = None):
        super().__init__(kept.root, read_only=True)
        self.study_store, self.owner = kept, owner

    def with_read_only(self, read_only: bool = False) -> CheckedZarrReader:
        """As it is: nothing is written this way."""
        return self

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """A file; FileError where it is damaged, or missing and should be there."""
        name, of_chunk, index = key.partition("/c/")
        if of_chunk and name in self.study_store.arrays:
            self.study_store.require_chunk(name, tuple(map(int, index.split("/"))))
        return await super().get(key, prototype, byte_range)
