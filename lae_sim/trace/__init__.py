"""The trace format: a sequence's recording, and reading, checking and writing of files."""
