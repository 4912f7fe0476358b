"""Work in processes, on this machine or on a Ray cluster.

:mod:`~.supervisor` distributes items and repeats the items of lost workers, :mod:`~.forking` starts processes, and
:mod:`~.confinement` restricts readers of third-party files. Besides compiled code, which the fork server loads, it
imports only :mod:`~pdhef_logtool.records`, and must not depend on an item's meaning.
"""
