"""Teaching of a car by drives (``learn``), and residual datasets and networks (``extract``, ``train``).

It reads and estimates drives by the functions of :mod:`~pdhef_logtool.runs`, and writes parts of a car. Only
:mod:`~pdhef_logtool.cli` may import it; the code that makes the shipped car is in ``studies.defaults``.
"""
