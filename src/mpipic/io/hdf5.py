"""Lay out an HDF5 file in memory: all that writers need of h5py, which never sees the disk.

A failed write leaves HDF5 with identifiers that can be neither used nor closed: a process then dies by a signal at its
end, and ranks that share a file wait for each other for ever. So HDF5 writes to a `StagedFile`, which cannot fail, and
no HDF5 object outlives a call. Data sets are only given their places; whoever holds the data writes them there.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from contextlib import suppress

import h5py

from mpipic.files import write_at
from mpipic.io.openpmd import Attributes, Tree

DataSets = dict[str, h5py.h5d.DatasetID]
"""Path to data set."""


class StagedFile:
    """A file to HDF5, which keeps what is written in memory until `commit`; what is older is read from the disk.

    Parameters
    ----------
    descriptor : of an empty file, open for reading and writing
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pending: list[tuple[int, bytes]] = []
        self._at = self._size = 0
        self.committed = 0
        """Bytes of the file that are on the disk and belong together."""

    def commit(self) -> None:
        """Write what is pending: what lies behind the file's end first, so that what was there stays valid if it fails.

        Raises OSError, with what was there as before; then what follows is `discard`.
        """
        behind = [(offset, data) for offset, data in self._pending if offset >= self.committed]
        within = [(offset, data) for offset, data in self._pending if offset < self.committed]
        before = [(offset, os.pread(self._descriptor, len(data), offset)) for offset, data in within]
        try:
            self._write([*behind, *within])
        except OSError:
            with suppress(OSError):
                self._write(before)
            raise
        self._pending.clear()
        self.committed = self._size

    def _write(self, pieces: Sequence[tuple[int, bytes]]) -> None:
        for offset, data in pieces:
            write_at(self._descriptor, memoryview(data), offset)

    def discard(self) -> None:
        """Forget what is pending, and give back the space behind what is committed."""
        self._pending.clear()
        self._size = self.committed
        with suppress(OSError):  # there will be less room, that is all
            os.ftruncate(self._descriptor, self.committed)

    # ------------------------------------------------------------ what HDF5 asks of a file

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place and return it."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """Return the place."""
        return self._at

    def write(self, data: bytes | memoryview) -> int:
        """Keep bytes for this place and go behind them."""
        kept = bytes(data)
        self._pending.append((self._at, kept))
        self._at += len(kept)
        self._size = max(self._size, self._at)
        return len(kept)

    def readinto(self, buffer: bytearray | memoryview) -> int:
        """Fill a buffer from this place on, with zeros where nothing was written, and go behind it."""
        into = memoryview(buffer).cast("B")
        begin, end = self._at, self._at + len(into)
        disk = os.pread(self._descriptor, len(into), begin)
        into[:] = disk.ljust(len(into), b"\0")
        for offset, data in self._pending:
            low, high = max(begin, offset), min(end, offset + len(data))
            if low < high:
                into[low - begin : high - begin] = data[low - offset : high - offset]
        self._at = end
        return len(into)

    def read(self, size: int) -> bytes:
        """Return bytes from this place on, and go behind them."""
        buffer = bytearray(size)
        self.readinto(buffer)
        return bytes(buffer)

    def truncate(self, size: int) -> int:
        """Set the size of the file."""
        self._size = size
        return size

    def flush(self) -> None:
        """Leave everything pending."""


def begin(staged: StagedFile, attributes: Attributes, group: str) -> None:
    """Lay out a new file with these attributes and an empty group."""
    with h5py.File(staged, "w") as file:
        file.attrs.update(attributes)
        file.create_group(group)


def add(staged: StagedFile, path: str, tree: Tree) -> dict[str, int]:
    """Lay out the groups, data sets and attributes of `tree` below the new group `path`.

    Returns the path in the tree of each data set that is not empty, and where in the file its bytes belong, in C order:
    behind what is committed.
    """
    with h5py.File(staged, "r+") as file:
        root, datasets = _create_tree(file, tree)
        offsets = {block.path: datasets[block.path].get_offset() for block in tree.blocks if 0 not in block.shape}
        file[path] = root
    assert min(offsets.values(), default=staged.committed) >= staged.committed
    return offsets


def _create_tree(file: h5py.File, tree: Tree) -> tuple[h5py.Group, DataSets]:
    """Create what a tree describes in a group that has no name yet; space is taken at once and not filled."""
    options = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    options.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    options.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    root = file.create_group(None)
    blocks = {block.path: block for block in tree.blocks}
    datasets: DataSets = {}
    for path, attributes in tree.attributes.items():
        if path in blocks:
            parent, _, name = path.rpartition("/")
            space = h5py.h5s.create_simple(blocks[path].shape)
            kind = h5py.h5t.py_create(blocks[path].data.dtype, logical=True)
            datasets[path] = h5py.h5d.create(root.require_group(parent).id, name.encode(), kind, space, options)
            target = h5py.Dataset(datasets[path])
        else:
            target = root.require_group(path) if path else root
        for key, value in attributes.items():
            target.attrs[key] = value
    return root, datasets
