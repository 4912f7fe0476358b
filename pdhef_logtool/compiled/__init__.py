"""Machine code that numba compiles, kept between processes.

:mod:`~.cache` provides the decorator of kernels, :mod:`~.sources` the digest of all sources under which the code is
kept. It imports only :mod:`~pdhef_logtool.records`, because every package with kernels imports it.
"""
