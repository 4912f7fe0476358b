"""Work in processes, on this machine or on a Ray cluster.

:mod:`~.supervisor` distributes items and repeats those of lost workers, :mod:`~.forking` starts processes, and

:mod:`~.confinement` restricts readers of third-party files. It imports only :mod:`~pdhef_logtool.records` and the
compiled code that a fork server loads, and must not depend on what an item is.
"""
