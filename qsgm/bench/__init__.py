"""Measure on folders of frames what the README states.

frames          a folder of demonstrations, with or without a manifest
accuracy        untouched, SGMs in int8 and float, backpropagation: same crops, same seed
accuracy_report what that says: table and JSON
layers          more and more layers tuned, or in blocks
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
fidelity        int8 gradients against float and true ones, on every frame
calibration     calibration sets from far to near, judged on other frames
step_jobs       training steps and forward passes to be timed
speed           seconds per stage in processes of their own, next to the same job in torch
peers           the same training step in other frameworks, a process each
peers_table     those next to own steps, in turns
growth          how a step's and a job's time grow, and where int8 wins
memory          live activations, and whole processes
resident        the most memory that a process held, said from inside
shapes          the layers' shapes, from a bundle
paper_table     the paper's Table 3, printed and counted
resources       multiply-adds, bytes and time, layer by layer
tables          tables of numbers
"""
