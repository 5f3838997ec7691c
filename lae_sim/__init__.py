"""Latency-aware evaluation of visual trackers: profile once per device, replay anywhere.

A tracker that needs 47 ms for a frame answers late: the target has moved on. A *trace* holds a
tracker's boxes and processing times on every frame of a dataset. Replaying it in a discrete-event
simulation says which frames the tracker would have processed, and how late its answers were, on
this device or another one; a *forecaster* predicts where the target is by then.

A short tour, with the traces that come with the sources:

    >>> import lae_sim
    >>> trace = lae_sim.read_trace("traces/synthetic-slow.parquet")
    >>> trace
    <Trace of 'slow-and-accurate' on 'synthetic': 8 sequences, 2,400 frames at 30 fps>
    >>> result = lae_sim.evaluate(trace, latency="constant:47ms", forecasters=["hold", "kalman"])
    >>> result
    <EvaluationResult of synthetic-slow.parquet, constant:47ms: AUC hold 0.5791, kalman 0.6414>
    >>> result.summary[["forecaster", "auc", "offline_auc", "recovered_auc"]].round(3)
      forecaster    auc  offline_auc  recovered_auc
    0       hold  0.579        0.777            NaN
    1     kalman  0.641        0.777          0.314
    >>> result.answers("boat-calm", "kalman").columns.tolist()[:6]
    ['frame', 'x', 'y', 'w', 'h', 'source_frame']
    >>> result.plot()
    <Figure ...>

``compare_forecasters`` adds intervals and tests, ``run_study`` crosses many traces, devices, rates
and latencies, and ``profile_tracker`` makes a trace of a tracker on this device.

Words of this package:

trace
    A tracker's boxes and processing times on every frame of a dataset, in a Parquet file.
world
    Under what a trace is replayed and scored: frame rate, policy, latency, permitted latency and
    so on (:class:`World`).
run
    One sequence of a trace, replayed: which frames were processed, and when each was ready.
hold
    No forecast: the latest output stands until the next. The baseline of all comparisons.
permitted latency, sigma
    How long after a frame's arrival its answer is asked for, in frames: at 0 at once, at 1 when the
    next frame arrives.
staleness
    How old the output is that answers for a frame: the mismatch in frames, or its age in ms.
departure
    A processed frame that follows another one than when it was recorded. The boxes of a tracker
    that searches near its last answer are then an approximation.
stride
    Mean number of frames from one processed frame to the next: 1 is every frame, 3/2 two of three.
pass
    One run of a tracker over the dataset, which leaves a trace. Passes at other strides make
    replays closer to what the tracker would have done.
convention
    How a toolkit counts frames without truth, and thresholds (:data:`CONVENTIONS`).

The names of this package are imported from their modules when they are first used, so that
``import lae_sim``, and the ``--help`` of a command, are fast. The rest is in the rooms,
``lae_sim.engine`` to ``lae_sim.report``.
"""

from lae_sim._faces import lazy_face

__version__ = "0.3.0"

__getattr__, __dir__ = lazy_face(__name__, __file__)
