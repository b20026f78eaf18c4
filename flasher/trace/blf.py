"""Reader of .blf trace files that limits the memory of python-can's reader.

A .blf file is a header and objects. Containers are objects that contain the objects with the
frames, compressed. python-can unpacks a whole container of any size, and loops forever on an object
of size 0.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from io import BufferedIOBase
from struct import Struct
from typing import Final

from flasher.trace.bounds import Bounds, UnfitError, check_unpacked

_HEADER: Final = Struct("<4sL64x")
"""Signature and size; the whole header is longer."""
_HEADER_MAX: Final = 4096
_OBJECT: Final = Struct("<4sHHLL")
"""Signature, size and version of the header, size of the object, type."""
_CONTAINER: Final = Struct("<H14x")
_CONTAINER_TYPE: Final = 10
_PLAIN, _PACKED = 0, 2
_SIGNATURE: Final = b"LOBJ"
_SEARCHED: Final = 8
"""Maximum distance in bytes to the next object."""
_FRAME_SIZES: Final = {1: 48, 73: 64, 86: 48, 100: 116, 101: 72}
"""Minimum size of each object type with a frame."""
_VERSIONS: Final = (1, 2)
_OBJECT_MAX: Final = 16 * 1024 * 1024
_PIECE_SIZE: Final = 65_536


class UnpackedBlf:
    """.blf file object for `can.BLFReader`: the same header, then the objects with frames, in
    uncompressed containers.
    """

    def __init__(self, source: BufferedIOBase, size: int, bounds: Bounds) -> None:
        """Open a file of `size` bytes. Raises UnfitError."""
        self._source = source
        self._bounds = bounds
        check_unpacked(self._unpacked(), size)
        source.seek(0)
        self._pieces = self._rewritten()
        self._ready = bytearray()

    def read(self, size: int) -> bytes:
        """Return the next `size` bytes, fewer at the end. Raises UnfitError."""
        while len(self._ready) < size and (piece := next(self._pieces, b"")):
            self._ready += piece
        taken = bytes(self._ready[:size])
        del self._ready[:size]
        return taken

    def close(self) -> None:
        """Do nothing: the caller closes its file."""

    def _header(self) -> bytes:
        """Return the part of the file header that python-can reads."""
        header = self._exactly(_HEADER.size)
        signature, size = _HEADER.unpack(header)
        if signature != b"LOGG" or not _HEADER.size <= size <= _HEADER_MAX:
            raise UnfitError("it has no header of this format")
        self._exactly(size - _HEADER.size)
        return header[:4] + _HEADER.size.to_bytes(4, "little") + header[8:]

    def _rewritten(self) -> Iterator[bytes]:
        yield self._header()
        held = bytearray()
        for piece in self._contents():
            held += piece
            frames = b"".join(self._objects(held))
            if frames:
                size = _OBJECT.size + _CONTAINER.size + len(frames)
                yield _OBJECT.pack(_SIGNATURE, _OBJECT.size, 1, size, _CONTAINER_TYPE)
                yield _CONTAINER.pack(_PLAIN) + frames + bytes(size % 4)
        if len(held) > _SEARCHED:
            raise UnfitError("it ends within an object")

    def _unpacked(self) -> Iterator[bytes]:
        self._header()
        yield from self._contents()

    def _contents(self) -> Iterator[bytes]:
        """Yield the unpacked content of the containers in pieces."""
        while head := self._source.read(_OBJECT.size):
            if len(head) < _OBJECT.size:
                raise UnfitError("it ends within an object")
            signature, _, _, size, kind = _OBJECT.unpack(head)
            left = size - _OBJECT.size
            if signature != _SIGNATURE or left < 0:
                raise UnfitError("an object does not begin where the one before it ends")
            unpack = None
            if kind == _CONTAINER_TYPE:
                method = _CONTAINER.unpack(self._exactly(_CONTAINER.size))[0]
                left -= _CONTAINER.size
                if method == _PACKED:
                    unpack = zlib.decompressobj()
                elif method != _PLAIN:
                    raise UnfitError(f"a container has an unknown compression: {method}")
            while left > 0:
                piece = self._source.read(min(left, _PIECE_SIZE))
                left -= len(piece)
                if unpack is not None:
                    yield unpack.decompress(piece, _PIECE_SIZE)
                    while unpack.unconsumed_tail:
                        yield unpack.decompress(unpack.unconsumed_tail, _PIECE_SIZE)
                elif kind == _CONTAINER_TYPE:
                    yield piece
                if not piece:
                    raise UnfitError("it ends within an object")
            self._source.read(size % 4)  # padding

    def _objects(self, held: bytearray) -> Iterator[bytes]:
        """Remove the complete objects from the start of `held`; yield those with a frame."""
        at = 0
        while len(held) - at >= _SEARCHED + _OBJECT.size:
            start = held.find(_SIGNATURE, at, at + _SEARCHED)
            if start < 0:
                raise UnfitError("an object does not begin where the one before it ends")
            _, _, version, size, kind = _OBJECT.unpack_from(held, start)
            least = _FRAME_SIZES.get(kind, _OBJECT.size)
            if not least <= size <= _OBJECT_MAX:
                raise UnfitError(f"an object of type {kind} states a size of {size:,} bytes")
            if start + size > len(held):
                break
            self._bounds.entry()
            if kind in _FRAME_SIZES and version in _VERSIONS:
                yield bytes(held[start : start + size])
            at = start + size
        del held[:at]

    def _exactly(self, size: int) -> bytes:
        data = self._source.read(size)
        if len(data) < size:
            raise UnfitError("it is cut off")
        return data
