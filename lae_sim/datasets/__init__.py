"""Datasets as their publishers lay them out: frames, ground truth, attributes; and made-up ones."""
