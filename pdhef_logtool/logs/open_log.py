"""The one way in: open any supported log by its content."""

from collections.abc import Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from pdhef_logtool.logs.byte_source import raise_source_error, require_regular, unreadable
from pdhef_logtool.logs.columnar_log import ColumnarLog
from pdhef_logtool.logs.compression import decompress_file
from pdhef_logtool.logs.container import MCAP_MAGIC, Container, describe_damage
from pdhef_logtool.logs.definitions import dbc_files, read_definitions
from pdhef_logtool.logs.discovery import names_of_logs
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.formats import HEAD_BYTES, ROSBAG2_METADATA, ZSTD_MAGIC, recognised_format, what_is_a_log
from pdhef_logtool.logs.remote_place import LogPlace, RemotePlace, place_of
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, Meter, ResourceLimits
from pdhef_logtool.logs.table_file import NO_SETTINGS, LogFile, TableSettings
from pdhef_logtool.records.errors import LogError, PdhefError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.storage.documents import read_text
from pdhef_logtool.storage.files import scratch_folder

_REMEDY = "give the recording itself"
_ONE_RECORDING = "name one recording; if the files are parts of one, --set folder=recording"
#: First bytes of a Git LFS pointer, which is in a repository in place of a large file that was not fetched.
LFS_POINTER = b"version https://git-lfs.github.com/spec/"


def open_log(
    path: LogPlace | str,
    limits: ResourceLimits = DEFAULT_LIMITS,
    msgs: Path | str | None = None,
    settings: TableSettings = NO_SETTINGS,
) -> DriveLog:
    """Open a log, recognised by its content.

    A file of one of the :mod:`~pdhef_logtool.logs.formats`, each also zstd-compressed; a rosbag2 folder with its
    ``metadata.yaml`` (split files are one log), a folder of CSV files of one recording
    (:mod:`~pdhef_logtool.logs.recording_folder`), or a folder with exactly one such file. Each file also by its URL
    (``https://``, ``s3://``).

    Parameters
    ----------
    limits : resource limits of reading; data beyond them are a loss.
    msgs : folder, zip file or wheel with definitions of types that the log does not define (:func:`read_definitions`);
        or a DBC file, or a folder of them, that defines the CAN frames of a log of tables.
    settings : for logs of tables.

    Raises
    ------
    LogError : the path is missing, no regular file, or no log.
    UsageError : ``msgs`` contains no definitions.
    """
    databases = dbc_files(msgs)
    definitions = read_definitions(None if databases else msgs)
    place = place_of(path) if isinstance(path, str) else path
    local = place if isinstance(place, Path) else Path()
    log = _opened(LogFile(local, place, Meter(limits), settings=settings))
    if log.messages is not None:
        log.messages.definitions = definitions
    log.given_databases = databases
    if databases:
        from pdhef_logtool.logs.can_decoding import load_dbc
        from pdhef_logtool.logs.table_log import TableLog

        if isinstance(log, TableLog):
            log.decode_frames([(path.name, load_dbc(path)) for path in databases])
    return log


def _opened(file: LogFile) -> DriveLog:
    path = file.place
    try:
        if isinstance(path, RemotePlace):
            opened = _open_remote(file, path)
        elif path.is_dir():
            return _open_folder(file)
        elif not path.exists():
            raise LogError(
                expected=what_is_a_log(), got="no such file", where=str(path), remedy="check the path", missing=True
            )
        else:
            opened = _open_file(file)
    except OSError as error:
        raise_source_error(error, str(path))
        raise unreadable(error, path) from error
    except PdhefError:
        raise
    except Exception as error:
        raise LogError(
            expected=what_is_a_log(), got=describe_damage(error)[1], where=str(path), remedy=_REMEDY
        ) from error
    if isinstance(opened, DriveLog):
        return opened
    return ColumnarLog(path, opened.kind, [opened], distro=opened.distro)


def log_metadata(path: LogPlace, limits: ResourceLimits = DEFAULT_LIMITS) -> dict[str, str]:
    """Return the metadata of a log: MCAP metadata records by ``key`` and ``record.key``, rosbag2's ``custom_data``.

    Raises
    ------
    LogError : as for :func:`open_log`.
    """
    with closing(open_log(path, limits)) as log:
        return log.metadata()


def _open_file(file: LogFile) -> Container | DriveLog:
    """Open one file; a compressed one is decompressed to a temporary one first."""
    if not _head_of(file.path).startswith(ZSTD_MAGIC):
        return _open_plain(file)
    stack = ExitStack()
    stack.callback(file.release)
    try:
        copy = Path(stack.enter_context(scratch_folder())) / file.path.stem
        with file.meter.running(file.path.stat().st_size):
            cut = decompress_file(file.path, copy, file.meter)
        return _open_plain(replace(file, path=copy, release=stack.close, cut=cut))
    except BaseException:
        stack.close()
        raise


def _open_remote(file: LogFile, place: RemotePlace) -> Container | DriveLog:
    """Open an object; a log without an index, or of a format that needs the whole file, is copied once."""
    from pdhef_logtool.logs.remote_source import RemoteSource

    source = RemoteSource(place)
    try:
        head = source.read(0, min(HEAD_BYTES, source.size))
        if head.startswith(MCAP_MAGIC):
            from pdhef_logtool.logs.mcap_log import McapContainer

            return McapContainer(file, source)
        file = replace(file, path=source.path, release=source.close)
        if head.startswith(ZSTD_MAGIC) or recognised_format(head, source.path.name) is not None:
            source.fetch_whole()
        return _open_file(file)
    except BaseException:
        source.close()
        raise


def _head_of(path: Path) -> bytes:
    require_regular(path)
    with path.open("rb") as file:
        return file.read(HEAD_BYTES)


def _open_plain(file: LogFile) -> Container | DriveLog:
    head = _head_of(file.path)
    is_pointer = head.startswith(LFS_POINTER[:HEAD_BYTES])
    log_format = None if is_pointer else recognised_format(head, file.path.name)
    if log_format is None:
        got, remedy = "a file that is none of these" if head else "an empty file", _REMEDY
        if is_pointer:
            got, remedy = "a pointer of Git LFS in place of the recording", "git lfs pull in its repository"
        raise LogError(expected=what_is_a_log(), got=got, where=str(file.place), remedy=remedy)
    opened = log_format.open(file)
    if isinstance(opened, Container) and file.path != file.place:
        opened.on_close(file.release)
        if file.cut:
            opened.lose("truncated", file.cut)
    return opened


def _open_folder(file: LogFile) -> DriveLog:
    from pdhef_logtool.logs.recording_folder import open_recording

    path = file.path
    if (path / ROSBAG2_METADATA).is_file():
        return _open_rosbag2_folder(file)
    logs = [path / name for name in sorted(names_of_logs(path))]
    if (recording := open_recording(file, logs)) is not None:
        return recording
    if len(logs) != 1:
        got = "a folder without a log" if not logs else f"a folder of {len(logs)} logs without metadata.yaml"
        raise LogError(expected=what_is_a_log(), got=got, where=str(path), remedy=_ONE_RECORDING if logs else _REMEDY)
    return _opened(replace(file, path=logs[0], place=logs[0]))


def _read_metadata(path: Path, limits: ResourceLimits) -> Mapping[str, Any]:
    from ruamel.yaml import YAML

    file = path / ROSBAG2_METADATA
    limits.check("metadata_bytes", file.stat().st_size, str(file))
    try:
        document = YAML(typ="safe").load(read_text(file))
        information = document["rosbag2_bagfile_information"]
        files = information["relative_file_paths"]
        if not isinstance(files, list) or not isinstance(information, dict):
            raise TypeError(f"{type(files).__name__} in place of a list")
    except OSError:
        raise
    except Exception as error:
        raise LogError(
            expected="rosbag2_bagfile_information with a list of relative_file_paths",
            got=f"a file without ({type(error).__name__})",
            where=str(file),
            remedy="re-index the folder with ros2 bag reindex, or give the storage file itself",
        ) from error
    return information


def _open_rosbag2_folder(folder: LogFile) -> ColumnarLog:
    path = folder.path
    information = _read_metadata(path, folder.meter.limits)
    per_message = _text(information.get("compression_mode")).lower() == "message"
    encodings = _declared_encodings(information)
    containers: list[Container] = []
    lost: list[Loss] = []
    with ExitStack() as stack:
        for name in map(_text, information["relative_file_paths"]):
            file = _storage_file(path, name)
            if file is None:
                lost.append(Loss("missing-file", f"{name} is named in metadata.yaml and absent", str(path)))
                continue
            try:
                container = _open_file(replace(folder, path=file, place=file))
                if not isinstance(container, Container):
                    container.close()
                    raise LogError(expected="a file of messages", got=f"a {container.kind} log", where=str(file))
            except Exception as error:  # noqa: BLE001 (one file of several)
                lost.append(Loss("bad-file", describe_damage(error)[1], str(file)))
                continue
            stack.callback(container.close)
            containers.append(container)
            container.zstd_messages = per_message
            # A topics table may name cdr by default where the recorder used another format: do not decode it as CDR.
            named = {id_: encodings.get(c.topic, c.encoding) for id_, c in container.channels.items()}
            container.channels |= {id_: replace(c, encoding=named[id_]) for id_, c in container.channels.items()}
        stack.pop_all()
    if not containers:
        remedy = lost[0].what if lost else "metadata.yaml names no file"
        raise LogError(expected=what_is_a_log(), got="no readable storage file", where=str(path), remedy=remedy)
    distro = _text(information.get("ros_distro"))
    kind = "rosbag2-mcap" if {c.kind for c in containers} != {"rosbag2-sqlite3"} else "rosbag2-sqlite3"
    custom = information.get("custom_data")
    about = {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}
    return ColumnarLog(path, kind, containers, lost, distro or containers[0].distro, about)


def _storage_file(folder: Path, name: str) -> Path | None:
    """Find a file that metadata.yaml names: as given, by its name alone, or with the suffix of file compression.

    Of a name that leads out of the folder only the last component counts.
    """
    given = Path(name)
    inside = not given.is_absolute() and ".." not in given.parts
    for candidate in (folder / given if inside else folder / given.name, folder / given.name):
        for file in (candidate, candidate.with_name(candidate.name + ".zstd")):
            if file.exists() and not file.is_dir():
                return file
    return None


def _declared_encodings(information: Mapping[str, Any]) -> dict[str, str]:
    """Return the serialization format that metadata.yaml declares for each topic; empty for a malformed list."""
    with suppress(TypeError, KeyError):
        topics = [entry["topic_metadata"] for entry in information["topics_with_message_count"]]
        formats = {_text(topic["name"]): _text(topic["serialization_format"]) for topic in topics}
        return {name: encoding for name, encoding in formats.items() if encoding}
    return {}


def _text(value: object) -> str:
    """Return a scalar of a YAML document as a text; lists with anchors can be endless and give an empty text."""
    return str(value) if isinstance(value, str | int | float) else ""
