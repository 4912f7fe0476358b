"""Exceptions of the package; each error has the parts expected, got, where and remedy."""

from functools import partial

from pdhef_logtool.records.printable import printable

EXIT_OK = 0
EXIT_FAILURE = 1
EXIT_USAGE = 2
EXIT_PARTIAL = 3
EXIT_GATE = 4


class PdhefError(Exception):
    """Base of all errors that a user can cause or repair.

    Parameters
    ----------
    expected : valid input.
    got : actual input.
    where : file, topic, field or option.
    remedy : action of the user; may be empty.
    missing : a file or folder in the user's input does not exist, which is a usage error.
    """

    exit_code: int = EXIT_FAILURE

    def __init__(self, *, expected: str, got: str, where: object, remedy: str = "", missing: bool = False) -> None:
        self.expected = expected
        self.got = got
        self.where = str(where)
        self.remedy = remedy
        self.missing = missing
        if missing:
            self.exit_code = EXIT_USAGE
        super().__init__(str(self))

    def __reduce__(self) -> "tuple[partial[PdhefError], tuple[()]]":
        """Pickle all parts, for other processes."""
        parts = {"expected": self.expected, "got": self.got, "where": self.where, "remedy": self.remedy}
        return partial(type(self), missing=self.missing, **parts), ()

    def __str__(self) -> str:
        """Return one line for the terminal; all parts are escaped."""
        where, expected, got, remedy = (
            printable(" ".join(str(part).split())) for part in (self.where, self.expected, self.got, self.remedy)
        )
        return f"{where}: expected {expected}, got {got}" + (f"; {remedy}" if remedy else "")


class UsageError(PdhefError):
    """The command line or a configuration value cannot be used."""

    exit_code = EXIT_USAGE


class LogError(PdhefError):
    """A file is not a log, or its contents are not readable."""


class MappingError(PdhefError):
    """A log does not contain a mapped or requested field."""


class MappingFileError(MappingError):
    """A mapping file is wrong."""

    exit_code = EXIT_USAGE


class VehicleError(PdhefError):
    """A vehicle file is wrong."""

    exit_code = EXIT_USAGE


class EstimatorError(PdhefError):
    """No estimator can run on this log."""


class SimulationError(PdhefError):
    """The requested drive cannot be simulated."""


class OutputError(PdhefError):
    """An output cannot be written, or an output folder cannot be read back.

    ``ends_run``: the run ends, because a disk is full or read-only and other outputs would fail too.
    """

    ends_run = False


class WorkerError(PdhefError):
    """Worker processes cannot be kept running."""


class ModelError(PdhefError):
    """A model bundle is missing, wrong, or does not belong to its weights."""

    exit_code = EXIT_USAGE
