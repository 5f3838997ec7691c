"""Latency-aware evaluation of visual trackers: profile once per device, replay anywhere.

A short tour::

    import lae_sim

    trace = lae_sim.read_trace("trace.parquet")
    runs = lae_sim.replay_trace(trace, source=lae_sim.constant(47_000_000))
    forecasters = {"hold": lae_sim.Hold, "kalman": lae_sim.Kalman}
    evaluation = lae_sim.evaluate(runs, trace.metadata, forecasters)
    print(evaluation.scores["auc"].mean(axis=1))

The public names are listed in ``__init__.pyi``. Each is imported from its module when it is first
used, so that ``import lae_sim``, and the ``--help`` of a command, are fast.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
