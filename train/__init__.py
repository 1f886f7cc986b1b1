"""Training of the learned prior: ``python -m train``, see :mod:`train.__main__` and :mod:`train.loop`."""
