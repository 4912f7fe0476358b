"""Version of the package, importable from every layer."""

__version__ = "0.2.0"
#: Writer name in output files.
LIBRARY = f"pdhef-logtool {__version__}"
