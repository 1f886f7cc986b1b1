"""Random scenes to train with, drawn as the training goes, and held-out ones to choose the weights
by.

Reading order: :mod:`~train.scenes.scene` (what a scene consists of, and its distribution), then
:mod:`~train.scenes.drawing` (a random one, in mm and HU), :mod:`~train.scenes.rasterise` (its voxel
values, painted by :mod:`~train.scenes.paint_kernels`), last :mod:`~train.scenes.held_out` (the
plaques of the validation).
"""
