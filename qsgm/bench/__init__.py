"""Measure on folders of frames what the pages in docs/ state: what `qsgm bench` runs.

Every study gives the values of its JSON; `render` makes tables of them, charts pictures.

frames          a folder of demonstrations, with or without a manifest
accuracy        untouched, SGMs in int8 and float, backpropagation: same crops, same seed
fidelity        int8 gradients against float and true ones, on every frame
calibration     calibration sets from far to near, judged on other frames
timing          training steps and forward passes, timed in turns
speed           seconds per stage in processes of their own, next to the same job in torch
resources       multiply-adds, bytes and time, layer by layer, and the paper's Table 3
memory          live activations, and whole processes
resident        the most memory that a process held, said from inside
charts          learning curves, fidelity over a run, memory and calibration as pictures
subjects        the objects that scenes are composed from: a folder's, or drawn ones
cutouts         an object off its table, laid elsewhere with its shadow
things          other things beside an object or over it
surfaces        tables with an edge, a gap or a sheet in view
lighting        a scene's light and camera
composing       scenes in pairs, with the object and without it, in nine conditions
judging         what answers to scenes are worth: outcomes, ROC, bootstrap intervals
scenes          teach on a demonstration, look for its object in composed scenes
rivals          other methods on the same scenes, a process each
scenes_report   what was found, as JSON and tables
scenes_picture  the same at a glance
scenes_run      all of that in the order of the command
"""
