"""The update of one frame (paper, algorithm 1): loop, schedule, rates, warm start, choice of Θ_t.

``frame_update`` has the loop. It keeps the schedule, the stopping rule, the gate on outlying cameras, looks and the
best state; an iteration is one call of an engine (``scas4d_core.engines``). It uses ``schedule`` (order of views,
samples, stopping), ``rates`` (how fast each parameter learns, and when), ``warm_start`` (the motion before as a start)
and ``best_state`` (the better of start and end). ``parts`` is how effects take part: values of the plan, and parts that
act before and after the iterations. ``robust`` decides around it which pictures and which results are believed.

The values that one update passes through, from ``Reconstruction.step`` to the commit:

1. ``engines.views.TrainingView``: one camera's pictures of the frame, made by ``view_factory``.
2. ``checkpoint.CarryOver``: all that the update before left beside Θ_{t−1}; in the end, that of this one.
3. ``robust.outliers.Past``: the usual figures of the scene and its cameras; a part of the carry-over.
4. ``warm_start.Motion``: the motion of the update before; a part of the carry-over.
5. ``preparation.PreparedUpdate``: the updater for today's clusters and effects, with the carry-over.
6. ``robust.update_input.UpdateInput``: the above, and the limits in time, for one frame.
7. ``result.AttemptOptions``: how one attempt at the frame is made.
8. ``result.UpdateTrace``: the record of an attempt.
9. ``result.UpdateResult``: the state that it ends with, its motion and trace.
10. ``frame_report.FrameReport``: the report that is committed beside the state.

``frame_context.FrameContext`` holds those of one frame on its way.
"""
