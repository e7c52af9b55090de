"""Evaluation of whole datasets with Lightning: batches, processes, resumption.

Nothing is imported here: Lightning takes seconds, and only ``run``, ``data`` and ``module`` need it.
"""
