"""Parameters and identified parts of one vehicle, and the nominal model that they parametrise.

:mod:`~.car` reads a car's folder; a part contains the digest of its inputs and is not used if one of them has changed.
It must not import anything that processes a log: a car is known before the drive.
"""
