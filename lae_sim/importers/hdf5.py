"""MATLAB files of version 7.3, which are HDF5: numbers, text, cells and structs.

See MathWorks, "MAT-File Versions", and the attributes that MATLAB leaves in its files: arrays are
stored transposed; text is a row of uint16; a cell is an array of references; a struct is a group,
and one with references in place of values is an array of structs.

HDF5 allows more than MATLAB writes: data in other files, links, filters, chunks that unpack to any
size. What MATLAB does not write is not followed, and sizes are checked before anything is read.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.decoding import Budget, TooLargeError
from lae_sim.errors import LaeError, install, one_line

if TYPE_CHECKING:
    import h5py

_MAX_DEPTH = 16
_MAX_CHUNKS = 4096
_OBJECT_BYTES = 1024  # what reading an object costs at least, in time too
_VALUE_BYTES = 8  # float64, and references about the same
_MAX_NAME_BYTES = 64
_CHARACTER, _CELL = "char", "cell"


def load_hdf5(path: Path) -> dict[str, Any]:
    """The variables of a file by name, as :func:`lae_sim.importers.matlab.load_matlab` gives them.

    Raises:
        LaeError: if h5py is not installed, the file is damaged, or larger than any result (see
            :func:`lae_sim.decoding.max_decoded`).
    """
    try:
        import h5py
    except ImportError as error:
        raise LaeError(
            f"{path}: a MATLAB file of version 7.3: to read it {install('mat73')}, or save it in "
            "MATLAB with save(..., '-v7')"
        ) from error
    try:
        with h5py.File(path, "r") as file:
            return _Reader(h5py, file, Budget(path)).members(file, 0)
    except (TooLargeError, MemoryError):
        raise
    except Exception as error:  # a damaged file can raise anything
        text = one_line(str(error))[:200]
        raise LaeError(f"{path}: not a readable MATLAB file: {text}") from error


class _Reader:
    """Reads values of a file within a budget."""

    def __init__(self, h5: Any, file: h5py.File, budget: Budget) -> None:
        self._h5 = h5
        self._file = file
        self._budget = budget

    def members(self, group: h5py.Group, depth: int) -> dict[str, Any]:
        """What a group holds by name, but for what MATLAB keeps for itself (``#refs#``)."""
        values = {}
        for name in group:
            if name.startswith("#"):
                continue
            if type(group.get(name, getlink=True)) is not self._h5.HardLink:
                raise ValueError("it has a link to data elsewhere")
            values[name] = self._value(group[name], depth + 1)
        return values

    def _value(self, item: Any, depth: int) -> Any:
        if depth > _MAX_DEPTH:
            raise ValueError("it is nested too deeply")
        self._budget.take(_OBJECT_BYTES)
        if isinstance(item, self._h5.Group):
            return self._struct(item, depth)
        if not isinstance(item, self._h5.Dataset):
            return None
        kind = self._class(item)
        if not item.shape or "MATLAB_empty" in item.attrs:
            return "" if kind == _CHARACTER else [] if kind == _CELL else np.empty((0, 0))
        stored = item.id.get_type().get_class()
        if stored == self._h5.h5t.REFERENCE:
            return [
                self._value(self._file[ref], depth + 1) if ref else None
                for ref in self._read(item).flat
            ]
        if stored not in (self._h5.h5t.INTEGER, self._h5.h5t.FLOAT):
            return None
        numbers = self._read(item)
        if kind == _CHARACTER:
            return numbers.astype("<u2").tobytes().decode("utf-16-le")
        with np.errstate(over="ignore"):
            return numbers.astype(np.float64, copy=False).T

    def _struct(self, group: h5py.Group, depth: int) -> Any:
        """A struct as a dict; several as a list of them."""
        fields = self.members(group, depth)
        several = [
            name
            for name, value in fields.items()
            if isinstance(value, list) and self._class(group[name]) is None
        ]
        if not fields or len(several) < len(fields):
            return fields
        count = min(len(value) for value in fields.values())
        return [{name: value[i] for name, value in fields.items()} for i in range(count)]

    def _class(self, item: Any) -> str | None:
        """MATLAB's name of a value's class, a short text of fixed length."""
        if "MATLAB_class" not in item.attrs:
            return None
        stored = item.attrs.get_id("MATLAB_class").get_type()
        if (
            stored.get_class() != self._h5.h5t.STRING
            or stored.is_variable_str()
            or stored.get_size() > _MAX_NAME_BYTES
        ):
            raise ValueError("the class of a value is no text")
        name = item.attrs["MATLAB_class"]
        return name.decode("latin-1") if isinstance(name, bytes) else None

    def _read(self, dataset: h5py.Dataset) -> Any:
        """The numbers of a dataset, if they are in the file itself and no more than they say."""
        plan = dataset.id.get_create_plist()
        if plan.get_external_count() or dataset.is_virtual:
            raise ValueError("it has data in another file")
        self._budget.take(math.prod(dataset.shape) * max(dataset.dtype.itemsize, _VALUE_BYTES))
        if dataset.chunks:
            self._check_chunks(dataset, plan)
        return dataset[()]

    def _check_chunks(self, dataset: h5py.Dataset, plan: Any) -> None:
        """Refuse chunks that unpack to more than their size, which HDF5 would find out too late."""
        size = math.prod(dataset.chunks) * dataset.dtype.itemsize
        self._budget.take(size)
        filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
        packed = filters == [self._h5.h5z.FILTER_DEFLATE]
        if filters and not packed:
            raise ValueError("it is packed as MATLAB packs none")
        count = dataset.id.get_num_chunks()
        if count > _MAX_CHUNKS:
            raise ValueError("it is in too many pieces")
        for i in range(count):
            chunk = dataset.id.get_chunk_info(i)
            self._budget.take(chunk.size)
            if packed and not chunk.filter_mask:
                _, raw = dataset.id.read_direct_chunk(chunk.chunk_offset)
                if len(zlib.decompressobj().decompress(raw, size + 1)) > size:
                    raise ValueError("it unpacks to more than it says")
