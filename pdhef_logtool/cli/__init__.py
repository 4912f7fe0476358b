"""The command line: options, help texts, and output to terminal and JSON.

A command parses its options, calls one function of :mod:`~pdhef_logtool.learning`, :mod:`~pdhef_logtool.runs`,
:mod:`~pdhef_logtool.reports` or :mod:`~pdhef_logtool.results`, and prints its result by a template of ``templates/``
(:mod:`~.printing`). No other package imports it, and only this package imports ``truthsim``.
"""
