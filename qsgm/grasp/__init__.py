"""Grasping: what the object looks like, where it may be, and whether that is it.

task, network and angles say what the network is for. Then two ways lead through this room.

Teaching: `teach` takes frames. `shown` measures and scales them (measuring, surroundings) and cuts
the object out (patch); `source` plans crops (crops) with other things on them (clutter,
distractors, others) and cuts them (pixels); `lesson` labels them. `taught` is what comes of it, and
a verdict on it (likeness, verdict).

Finding: `tuned` runs its network over a frame (heatmap, candidates). `finding` has every place
judged: `judge` lays the patch there, coarse to fine (correlation, cells, alignment), and
by its edges (edges, outline, snapping); `decision` weighs how that fits and what the network says
(evidence) and how alike the two look (comparer).

What is said of both: report, sights (several objects), pictures, watch (frame after frame).
"""
