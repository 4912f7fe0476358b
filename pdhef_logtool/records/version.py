"""The version, where every floor may read it."""

__version__ = "0.2.0"
#: Writer name in our files.
LIBRARY = f"pdhef-logtool {__version__}"
