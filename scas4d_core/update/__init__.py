"""The update of one frame (paper, algorithm 1): loop, schedule, learning rates, warm start and selection of Θ_t.

``frame_update`` contains the loop. It handles the schedule, the stopping rule, the exclusion of outlying cameras, the
probe errors and the best state. An iteration is one call to an engine (``scas4d_core.engines``). The loop uses
``schedule`` (order of views, samples, stopping) and ``rates`` (learning rate and period of each parameter). It also
uses ``warm_start`` (start from the previous motion) and ``best_state`` (the better of start and end). ``parts`` defines
how effects contribute: by values of the plan, and by parts that act before and after the iterations. ``robust`` decides
which images and which results are accepted.

The objects involved in one update, from ``Reconstruction.step`` to the commit, are:

1. ``engines.views.TrainingView``: one camera's image of the frame, created by ``view_factory``.
2. ``checkpoint.CarryOver``: the data that an update passes on to the next one, in addition to its state.
3. ``robust.outliers.Past``: the usual values of the scene and its cameras, which are part of the carry-over.
4. ``warm_start.Motion``: the motion of the previous update, which is part of the carry-over.
5. ``preparation.PreparedUpdate``: the updater for the current clusters and effects, with the carry-over.
6. ``robust.update_input.UpdateInput``: the input to the update of one frame, assembled from the above, with a time
   limit.
7. ``result.AttemptOptions``: the options of one attempt at the frame.
8. ``result.UpdateTrace``: the record of an attempt.
9. ``result.UpdateResult``: the final state, its motion and trace.
10. ``frame_report.FrameReport``: the report that is committed with the state.

``frame_context.FrameContext`` contains these objects while a frame is processed.
"""
