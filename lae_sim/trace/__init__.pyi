from .file import Trace, read_held, read_trace, validate, write_trace
from .locate import find_traces
from .metadata import ImageSizes, Metadata
from .recording import Recording, batched

__all__ = [
    "ImageSizes",
    "Metadata",
    "Recording",
    "Trace",
    "batched",
    "find_traces",
    "read_held",
    "read_trace",
    "validate",
    "write_trace",
]
