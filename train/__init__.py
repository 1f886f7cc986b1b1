"""Training of the learned prior: ``torchpcct train``, see :mod:`train.__main__`.

Reading order: :mod:`train.config` (what a run is); :mod:`train.scenes`, :mod:`train.data` and
:mod:`train.objective` (what it sees and minimises); :mod:`train.loop`, which drives a
:mod:`train.run` with the gradients of :mod:`train.processes`; :mod:`train.checkpoint` and
:mod:`train.logs` (what it leaves behind beside its weights).
"""
