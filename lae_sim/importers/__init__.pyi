from .convert import ConversionSummary, convert_results
from .lae_pvt import read_run
from .results import find_results, read_results

__all__ = [
    "ConversionSummary",
    "convert_results",
    "find_results",
    "read_results",
    "read_run",
]
