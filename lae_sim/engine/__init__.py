"""The discrete-event engine: exact time, scheduling policies, and who processes which frame when.

It knows no trace, no tracker and no metric: a service says how long a frame takes.
"""
