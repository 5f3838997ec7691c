"""The command lines: options become records, records go to the rooms, answers are printed."""
