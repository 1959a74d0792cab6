"""Open an HDF5 file for all ranks and write blocks of data sets to it: all that snapshots need of h5py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from mpipic.io.openpmd import Numbers, Tree

if TYPE_CHECKING:
    from mpi4py import MPI

DataSets = dict[str, h5py.h5d.DatasetID]
"""Path to data set, on ranks that write."""


def has_mpi() -> bool:
    """Return whether this h5py can open one file on all ranks."""
    return bool(h5py.get_config().mpi)


def create_file(path: Path, comm: MPI.Comm | None = None) -> h5py.File:
    """Create a file, replacing an old one: on all ranks of `comm` together when given, else on this rank alone."""
    options = {} if comm is None else {"driver": "mpio", "comm": comm}
    return h5py.File(path, "w", **options)


def create_tree(file: h5py.File, tree: Tree) -> tuple[h5py.Group, DataSets]:
    """Create the groups, data sets and attributes of a snapshot in a group that has no name yet.

    Returns the group, to be linked into the file when its data are complete, and the data sets by path. Space is taken
    at once and not filled. Collective on a file that is open on all ranks.
    """
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


def release(group: h5py.Group | None, datasets: DataSets) -> None:
    """Close what `create_tree` returned, now: HDF5 deadlocks when ranks leave it to the garbage collector's order."""
    for identifier in [*datasets.values(), *([] if group is None else [group.id])]:
        while identifier.valid:
            h5py.h5i.dec_ref(identifier)


def write_block(dataset: h5py.h5d.DatasetID, start: Sequence[int], data: Numbers, collective: bool) -> None:
    """Write `data` at `start` of a data set; with `collective`, all ranks take part, those with empty `data` too."""
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    if collective:
        transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    there = dataset.get_space()
    if data.size:
        here = h5py.h5s.create_simple(data.shape)
        there.select_hyperslab(tuple(start), data.shape)
    else:
        here, data = h5py.h5s.create_simple((1,)), np.zeros(1, data.dtype)
        here.select_none()
        there.select_none()
    dataset.write(here, there, np.ascontiguousarray(data), dxpl=transfer)
