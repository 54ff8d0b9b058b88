"""Measure on folders of frames what the README states.

frames    a folder of demonstrations, with or without a manifest
accuracy  untouched, synthetic gradients in int8 and float, backpropagation: same crops, same seed
staging   scenes made from a demonstration: the object elsewhere, turned, in other light, or gone
scenes    teach on a frame, find the object in such scenes
speed     seconds per stage in processes of their own, next to the same job in torch
peers     the same training step in other frameworks
growth    how a step's and a job's time grow, and where int8 wins
memory    live activations and whole processes
resources multiply-adds, bytes and time, next to the paper's Table 3
fidelity  int8 gradients against float and true ones
calibration  calibration sets from far to near
"""
