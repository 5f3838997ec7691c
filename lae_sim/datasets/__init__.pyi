from .annotations import GroundTruth, find_truth, read_truth
from .attributes import read_attributes
from .frames import Dataset, Image, ImageSequence
from .layouts import find_dataset
from .synthetic import synthetic_dataset

__all__ = [
    "Dataset",
    "GroundTruth",
    "Image",
    "ImageSequence",
    "find_dataset",
    "find_truth",
    "read_attributes",
    "read_truth",
    "synthetic_dataset",
]
