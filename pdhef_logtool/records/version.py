"""The version, where every floor may read it."""

__version__ = "0.2.0"
#: What files that we write say that they were written by.
LIBRARY = f"pdhef-logtool {__version__}"
