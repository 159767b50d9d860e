"""A zip that nobody trusts, unpacked into a new folder: every entry is judged before the first byte is written.

Declared sizes are not believed: what counts against the limits is what comes out. Unpacking writes plain files
and folders only, so there is nothing in the folder that could point out of it.
"""

import io
import lzma
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from service.bundle_names import check_name, folded_name, is_system_file
from service.errors import BundleError, BundleTooLargeError, HostileBundleError

RATIO_FLOOR_NBYTES = 1 << 20  # so little may be compressed as well as it can be
_CHUNK_NBYTES = 1 << 20
_MAX_ENTRY_RECORD_NBYTES = 2048  # of the central directory, on average: name, extra fields, comment
_LOCAL_HEADER_NBYTES = 30
_ENCRYPTED = 0x1 | 0x40 | 0x2000
_METHODS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_ZIP_START = b"PK\x03\x04"
_BROKEN = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, RuntimeError, ValueError,
           OverflowError, UnicodeError)  # fmt: skip  # what zipfile raises for a broken file


@dataclass(frozen=True, kw_only=True)
class ArchiveLimits:
    """What one archive may cost.

    Attributes:
        max_nbytes: bytes of all files together, unpacked.
        max_files: entries, folders included.
        max_ratio: unpacked bytes over packed bytes, above the first MiB.
    """

    max_nbytes: int
    max_files: int
    max_ratio: float


@dataclass
class Unpacked:
    """What came out of an archive.

    Attributes:
        files: paths relative to the folder, sorted.
        nbytes: their bytes together.
        notes: what was left out.
    """

    files: list[str] = field(default_factory=list)
    nbytes: int = 0
    notes: list[str] = field(default_factory=list)


class _ArchiveFile(io.FileIO):
    """zipfile reads the directory of an archive in one go, as large as the archive says it is, and wherever."""

    max_read_nbytes = 1 << 62

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > self.max_read_nbytes:
            raise BundleTooLargeError(
                "bundle", f"must have a directory of at most {self.max_read_nbytes} bytes", f"{size}; pack fewer files"
            )
        return super().read(size) or b""

    def seek(self, offset: int, whence: int = 0, /) -> int:
        try:
            return super().seek(offset, whence)
        except OSError as error:  # no such place: the archive is damaged, not the disk
            if whence != os.SEEK_SET:
                raise  # zipfile looks for an end that short files do not have
            raise zipfile.BadZipFile(f"there is no byte {offset}") from error


def unpack(archive: Path, folder: Path, limits: ArchiveLimits) -> Unpacked:
    """Unpacks an archive into an empty folder.

    Raises:
        BundleError: it is no zip, is damaged, or an entry breaks a rule; the folder may then hold some files.
        OSError: the disk does not take them.
    """
    with _ArchiveFile(archive) as file:
        file.max_read_nbytes = max(1 << 18, limits.max_files * _MAX_ENTRY_RECORD_NBYTES)
        try:
            opened = zipfile.ZipFile(file)
        except BundleError:
            raise
        except _BROKEN as error:
            raise BundleError("bundle", "must be a zip archive", f"{_told(error)}; upload a .zip") from None
        file.max_read_nbytes = _ArchiveFile.max_read_nbytes
        with opened:
            entries = list(_checked_entries(opened.infolist(), limits))
            packed_nbytes = os.fstat(file.fileno()).st_size
            _check_overlaps(entries, packed_nbytes)
            return _extract(opened, entries, folder, limits, packed_nbytes)


def _checked_entries(infos: list[zipfile.ZipInfo], limits: ArchiveLimits) -> Iterator[tuple[zipfile.ZipInfo, str]]:
    """Every entry with its checked name, folders too."""
    if len(infos) > limits.max_files:
        raise BundleTooLargeError("bundle", f"must hold at most {limits.max_files} files", f"{len(infos)}")
    declared = sum(info.file_size for info in infos)
    if declared > limits.max_nbytes:
        raise BundleTooLargeError("bundle", f"must unpack to at most {limits.max_nbytes} bytes", f"{declared}")
    seen: dict[str, bool] = {}
    for info in infos:
        check_name(info.orig_filename)
        name = check_name(info.filename)
        _check_kind(info, name)
        _check_collisions(name, info.is_dir(), seen)
        yield info, name


def _check_overlaps(entries: list[tuple[zipfile.ZipInfo, str]], packed_nbytes: int) -> None:
    """Entries that share their packed bytes unpack to more than any ratio of one entry allows (Fifield 2019)."""
    end, later = packed_nbytes, ""
    for info, name in sorted(entries, key=lambda entry: entry[0].header_offset, reverse=True):
        if info.header_offset < 0 or info.header_offset + _LOCAL_HEADER_NBYTES + info.compress_size > end:
            got = f"bytes of {later!a}" if later else "bytes that are not there"
            raise HostileBundleError(f"entry {name!a}", "must be whole and have bytes of its own", got)
        end, later = info.header_offset, name


def _check_kind(info: zipfile.ZipInfo, name: str) -> None:
    entry = f"entry {name!a}"
    if info.flag_bits & _ENCRYPTED:
        raise BundleError(entry, "must not be encrypted", "an encrypted entry; pack it without a password")
    if info.compress_type not in _METHODS:
        raise BundleError(entry, "must be stored or deflated", f"method {info.compress_type}; pack it as plain zip")
    if info.volume:
        raise BundleError(entry, "must lie in this archive", f"volume {info.volume}; pack it without splitting")
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise HostileBundleError(entry, "must be a file or folder", "a symbolic link; pack what it points to")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise HostileBundleError(entry, "must be a file or folder", f"a special file (mode {kind:o})")
    if (kind == stat.S_IFDIR or info.external_attr & 0x10) and not info.is_dir():
        raise HostileBundleError(entry, "must be a file or folder", "a folder by its mode and a file by its name")
    if info.is_dir() and (kind == stat.S_IFREG or info.file_size):
        raise HostileBundleError(entry, "must be a file or folder", "a folder that holds data")


def _check_collisions(name: str, is_folder: bool, seen: dict[str, bool]) -> None:
    """`seen` maps folded names to whether they are files; the folders above an entry count as seen."""
    folded = folded_name(name)
    entry, segments = f"entry {name!a}", folded.split("/")
    for depth in range(1, len(segments)):
        if seen.setdefault("/".join(segments[:depth]), False):
            raise HostileBundleError(entry, "must lie in a folder", f"the file {'/'.join(segments[:depth])!a}")
    if is_folder and seen.get(folded) is False:
        return
    if folded in seen:
        raise HostileBundleError(entry, "must have a name of its own, also where case and form are ignored",
                                 "a second entry of this name")  # fmt: skip
    seen[folded] = not is_folder


def _extract(opened: zipfile.ZipFile, entries: list[tuple[zipfile.ZipInfo, str]], folder: Path, limits: ArchiveLimits,
             packed_nbytes: int) -> Unpacked:  # fmt: skip
    result = Unpacked()
    most = min(limits.max_nbytes, max(RATIO_FLOOR_NBYTES, int(limits.max_ratio * packed_nbytes)))
    for info, name in entries:
        if info.is_dir():
            continue
        if is_system_file(name):
            result.notes.append(f"{name}: left out, a hidden or system file")
            continue
        try:
            with opened.open(info) as source:
                written = _write(source, folder / name, most - result.nbytes, limits, packed_nbytes)
        except BundleError:
            raise
        except _BROKEN as error:
            raise BundleError(f"entry {name!a}", "must be whole", f"{_told(error)}; pack it again") from None
        if written is None:
            result.notes.append(f"{name}: left out, archives in archives are not opened")
            continue
        result.nbytes += written
        result.files.append(name)
    result.files.sort()
    return result


def _write(source: IO[bytes], target: Path, room_nbytes: int, limits: ArchiveLimits,
           packed_nbytes: int) -> int | None:  # fmt: skip
    """Bytes written; None where the entry is an archive itself, which is not kept."""
    first = source.read(_CHUNK_NBYTES)
    if first.startswith(_ZIP_START):
        return None
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with target.open("xb") as file:
        chunk = first
        while chunk:
            written += len(chunk)
            if written > room_nbytes:
                raise BundleTooLargeError(
                    f"entry {target.name!a}",
                    f"must not make the bundle unpack to over {limits.max_nbytes} bytes or {limits.max_ratio:g} "
                    f"times its {packed_nbytes} bytes",
                    "more",
                )
            file.write(chunk)
            chunk = source.read(_CHUNK_NBYTES)
        file.flush()
        os.fsync(file.fileno())
    return written


def _told(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
