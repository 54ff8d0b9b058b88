"""Static synthetic gradient modules as plain arrays: in float, in int8, and the ranges between."""
