"""Files that know whether they are whole, written so that an earlier one is never lost.

A file is a row of frames. Each is a header of 512 bytes and an image, which is an HDF5 file by
itself: of the header as HDF5's user block, so that any reader of HDF5 opens the first frame. The
header holds the length of the image, its SHA-256, the digest of the header before it (frames of
two files cannot be mixed), and its own: no byte of a file can change unseen. `save` and `sweep`
write one frame; a recording appends one a chunk.
"""

import contextlib
import hashlib
import io
import os
import secrets
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import h5py

HEADER_SIZE = 512
EXTENSIONS = (".h5", ".hdf5", ".hdf", ".he5")
_MAGIC = b"RODJAX\r\n"
_FIELDS = struct.Struct("<8sQ32s32s")  # magic, length, digest of the image, previous header's
_HDF5 = b"\x89HDF\r\n\x1a\n"
_FIRST = bytes(32)


class StorageError(ValueError):
    """A file that cannot be written or read as asked; the message says what to do."""


class Frame(NamedTuple):
    """Where an image lies in its file, and the digest of its header."""

    start: int
    length: int
    digest: bytes

    @property
    def stop(self) -> int:
        """Where the next frame's header begins."""
        return self.start + self.length


class Frames(NamedTuple):
    """The whole frames of a file; `torn` if one more was begun. None: a file without seals."""

    whole: list[Frame] | None
    torn: bool


def hdf5_path(path: str | os.PathLike) -> Path:
    """The path, if a file of HDF5 can be written there.

    Raises:
        StorageError: not a path, a folder, or the name of a file of another kind.
    """
    if not isinstance(path, str | os.PathLike):
        raise StorageError(f"path: give the file's name first, 'run.h5'; got {_kind(path)}")
    path = Path(path)
    if path.is_dir():
        raise StorageError(f"path: {path} is a folder; give a file in it, {path / 'run.h5'}")
    if path.suffix and path.suffix.lower() not in EXTENSIONS:
        raise StorageError(
            f"path: only HDF5 is written, in files named {path.stem}.h5, not {path.suffix}; for a"
            " table of your own use numpy.savetxt(path, columns)"
        )
    return path


def _kind(value) -> str:
    return "nothing" if value is None else f"a {type(value).__name__}"


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[h5py.File]:
    """A new HDF5 file that takes the place of an earlier one only when complete on the disk.

    Raises:
        StorageError: the path is no place for such a file, or the disk refuses it.
    """
    path = hdf5_path(path)
    target = Path(os.path.realpath(path))  # what a link points to is replaced, not the link
    # of no other name: another thread may be writing to this path
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(temporary, "x", userblock_size=HEADER_SIZE) as file:
            yield file
        seal(temporary)
        os.replace(temporary, target)
        _flush_entries(target.parent)
    except OSError as error:
        raise StorageError(f"path: {path} cannot be written: {error}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def seal(path: Path) -> None:
    """Write the header of a file that HDF5 has written behind an empty user block."""
    with open(path, "r+b") as stream:
        length = stream.seek(0, os.SEEK_END) - HEADER_SIZE
        stream.seek(HEADER_SIZE)
        digest = _digest_of(stream, length)
        stream.seek(0)
        stream.write(_header(length, digest, _FIRST))
        stream.flush()
        os.fsync(stream.fileno())


def framed(image: bytes, last: Frame) -> tuple[bytes, Frame]:
    """Header and image to be written behind the last frame of a file, and where they then lie."""
    header = _header(len(image), hashlib.sha256(image).digest(), last.digest)
    digest = header[_FIELDS.size : _FIELDS.size + 32]
    return header + image, Frame(last.stop + HEADER_SIZE, len(image), digest)


def frames(stream: io.BufferedIOBase, path: Path) -> Frames:
    """The frames of a file, each compared with its digests.

    Raises:
        StorageError: a byte was changed since it was written, or the file is of another kind.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if stream.read(len(_HDF5)) == _HDF5:
        return Frames(None, False)
    found: list[Frame] = []
    previous, start = _FIRST, 0
    while start < size:
        stream.seek(start)
        header = stream.read(HEADER_SIZE)
        if len(header) < HEADER_SIZE:
            break
        magic, length, digest, before = _FIELDS.unpack(header[: _FIELDS.size])
        if start == 0 and magic != _MAGIC:
            raise StorageError(f"path: {path} is not an HDF5 file that rodjax wrote, or is damaged")
        if header != _header(length, digest, before) or before != previous:
            raise _damaged(path, found)
        frame = Frame(start + HEADER_SIZE, length, header[_FIELDS.size : _FIELDS.size + 32])
        if frame.stop > size:
            break
        if _digest_of(stream, length) != digest:
            raise _damaged(path, found)
        found.append(frame)
        previous, start = frame.digest, frame.stop
    if not found:
        raise StorageError(f"path: {path} is cut off ({size} bytes); nothing of it is whole")
    return Frames(found, start < size)


def _damaged(path, found):
    mend = "restore it from a copy"
    if found:
        mend += f", or cut it off after {found[-1].stop} bytes, up to which it is whole"
    return StorageError(
        f"path: {path} is damaged: its bytes are not those that were written (or it was edited);"
        f" {mend}"
    )


def _header(length: int, digest: bytes, previous: bytes) -> bytes:
    fields = _FIELDS.pack(_MAGIC, length, digest, previous)
    return (fields + hashlib.sha256(fields).digest()).ljust(HEADER_SIZE, b"\0")


def _digest_of(stream: io.BufferedIOBase, length: int) -> bytes:
    """Digest of the next bytes of a stream."""
    total = hashlib.sha256()
    while length > 0:
        block = stream.read(min(length, 1 << 20))
        if not block:
            break
        total.update(block)
        length -= len(block)
    return total.digest()


def _flush_entries(folder: Path) -> None:
    """Have the operating system write the entries of a folder to the disk."""
    if os.name != "posix":  # elsewhere folders cannot be opened
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
