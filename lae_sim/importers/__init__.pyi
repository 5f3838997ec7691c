from .convert import ConversionSummary, convert_results
from .lae_pvt import read_run
from .log_table import read_table
from .measured import convert_log
from .results import find_results, read_results
from .rosbag import BagOptions, read_bag

__all__ = [
    "BagOptions",
    "ConversionSummary",
    "convert_log",
    "convert_results",
    "find_results",
    "read_bag",
    "read_results",
    "read_run",
    "read_table",
]
