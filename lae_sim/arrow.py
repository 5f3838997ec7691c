"""Arrow arrays from and to NumPy through their buffers.

``pa.array(ndarray)`` and ``Array.to_numpy()`` import pandas where it is installed, and ``cast`` and
``take`` import ``pyarrow.compute``, which costs more than reading a trace; these do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt


def checksums(option: str) -> dict[str, bool]:
    """The option that writes or checks page checksums, where pyarrow has it (15 and newer)."""
    import pyarrow as pa

    return {option: True} if int(pa.__version__.split(".")[0]) >= 15 else {}


def from_numpy(values: npt.NDArray[Any], valid: npt.NDArray[np.bool_] | None = None) -> Any:
    """An Arrow array of one-dimensional numbers; null where ``valid`` is false."""
    import pyarrow as pa

    values = np.ascontiguousarray(values)
    bitmap = None
    if valid is not None and not valid.all():
        bitmap = pa.py_buffer(np.packbits(valid, bitorder="little").tobytes())
    arrow_type = pa.from_numpy_dtype(values.dtype)
    return pa.Array.from_buffers(arrow_type, len(values), [bitmap, pa.py_buffer(values)])


def from_texts(texts: Sequence[str], times: int = 1) -> Any:
    """An Arrow array of texts, each so many times in a row."""
    import pyarrow as pa

    encoded = [text.encode() for text in texts]
    sizes = np.repeat(np.array([len(text) for text in encoded], np.int32), times)
    ends = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    joined = b"".join(text * times for text in encoded)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(joined)]
    return pa.Array.from_buffers(pa.string(), len(sizes), buffers)


def to_numpy(array: Any, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """The values of a primitive Arrow array; what stands where it is null is arbitrary."""
    data = array.buffers()[1]
    if data is None:
        return np.zeros(len(array), dtype)
    return np.frombuffer(data, dtype, len(array), array.offset * np.dtype(dtype).itemsize)


def is_null(array: Any) -> npt.NDArray[np.bool_]:
    """Where an Arrow array is null, bool [n]."""
    bitmap = array.buffers()[0]
    if bitmap is None or not array.null_count:
        return np.zeros(len(array), np.bool_)
    end = array.offset + len(array)
    bits = np.unpackbits(np.frombuffer(bitmap, np.uint8), count=end, bitorder="little")
    null: npt.NDArray[np.bool_] = bits[array.offset :] == 0
    return null
