"""Pretraining in five stages, from drawn tasks to a checkpoint.

tasks       training data: crops, features of the frozen layers, labels
backbone    stage 1: the network, by backpropagation
matching    stage 2: SGMs regress true gradients
own_runs    stage 2, gone on with: along runs that the SGMs drive themselves
first_rates stage 3, before it: the rates that it starts with
maml        stage 3: SGMs, start and rates through whole runs that the SGMs drive
map_sgms    stage 4: SGMs behind the layers with maps
rates       stage 5: the rates that runs of one to six layers start with
recipes     stage 5 of tasks of samples: optimizer and rates by a run's length
evaluate    whole fine-tuning runs, and their scores
resume      finished stages on disk, to go on with after an interruption
pretrain    the stages in their order
"""
