"""Records that every package shares: signals, tracks, errors, geometry, reasons.

They contain arrays and no behaviour of a format, a car or an algorithm. It must not import any other package.
"""
