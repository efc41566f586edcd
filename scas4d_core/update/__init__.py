"""Update of one frame (paper, algorithm 1): Θ_{t−1} and the pictures of frame t in, Θ_t out.

``frame_update`` has the loop; it uses ``schedule`` (iterations, views, samples, rates, Adam),
``warm_start``, ``deformation`` (the cascade and the neighbour terms), ``picture_loss`` (render and compare) and
``best_state`` (the better of start and end), and calls the parts that the ``effects`` of the scene put into it.
``robust`` decides around it which pictures and which results are believed.

The values that one update passes through, from ``Reconstruction.step`` to the commit:

1. ``training_view.TrainingView``: one camera's pictures of the frame.
2. ``checkpoint.CarryOver``: all that the update before left beside Θ_{t−1}; in the end, that of this one.
3. ``robust.outliers.Past``: the usual figures of the scene and its cameras; a part of the carry-over.
4. ``warm_start.Motion``: the motion that was found; a part of the carry-over.
5. ``robust.update_input.UpdateInput``: the above, and the limits in time, for one frame.
6. ``result.AttemptOptions``: how one attempt at the frame is made.
7. ``result.UpdateTrace``: the record of an attempt, filled while it runs.
8. ``result.UpdateResult``: the state that it ends with, its motion and trace.
9. ``frame_report.FrameReport``: the report that is committed beside the state.
"""
