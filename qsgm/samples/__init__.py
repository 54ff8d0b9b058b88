"""Networks and tasks of one's own: labelled samples in, every head's answer out.

task: what a task file defines; lesson: samples as a lesson, and what answers are worth.
arrays: the built-in task whose samples are an `.npz`; taskfile: a task file, read and checked.
teach: tuning on samples; tuned: what comes out; report: as tables and JSON.
"""
