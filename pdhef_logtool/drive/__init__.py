"""From a mapped log to one drive: aligned signals [N] and ground truth at the same stamps, with checks and corrections.

:mod:`~.plan` decides once how a drive is read, :mod:`~.recorded` reads it whole, :mod:`~.survey` corrects units, signs
and mounting. It must not import estimators.
"""
