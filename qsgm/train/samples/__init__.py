"""Tasks of one's own on the host: drawn: what pretraining and calibration take; build: in one call.

arrays: the task `arrays` from a JSON file and a pool of samples.
"""
