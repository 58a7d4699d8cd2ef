"""Radiance HDR pictures (RGBE): flat and new-style run-length scanlines.

Source: the Radiance reference manual, 'filefmts'.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from nlos_lit.capture.errors import CaptureError

_LARGEST = 2**30  # bytes of a picture
_SIZE_LINE = re.compile(rb"-Y (\d{1,9}) \+X (\d{1,9})\n")


def read_radiance(path: Path) -> np.ndarray:
    """A picture's colours.

    Args:
        path: of the file.

    Returns:
        ``[rows, columns, 3]`` float32 red, green, blue.

    Raises:
        CaptureError: no size line, another orientation, a picture cut short, or a broken run.
    """
    on_disk = path.stat().st_size
    if on_disk > _LARGEST:
        raise CaptureError(f"{path.name} has {on_disk / 1e9:.1f} GB; no picture of a transient is so large")
    data = path.read_bytes()
    header = data[:65536]
    size = _SIZE_LINE.search(header)
    if size is None or b"32-bit_rle_xyze" in header[: size.start()]:
        raise CaptureError(
            f"{path.name} is not an RGBE picture from the top left ('-Y rows +X columns'); save it so"
        )
    rows, columns = int(size[1]), int(size[2])
    if rows < 1 or columns < 1:
        raise CaptureError(f"{path.name} is a picture of {rows} × {columns} pixels")
    body = memoryview(data)[size.end() :]
    # A packed row has four bytes before it, and in each of four channels two for a run of at most 127 pixels.
    least = 4 + 8 * -(-columns // 127) if 8 <= columns < 32768 else 4 * columns
    if rows * least > len(body):
        raise CaptureError(
            f"{path.name} is cut short: {len(body)} bytes cannot hold {rows} × {columns} pixels"
        )
    if len(body) == 4 * rows * columns and not _is_run_length(body, columns):
        pixels = np.frombuffer(body, np.uint8).reshape(rows, columns, 4)
    else:
        pixels = _decode_runs(body, rows, columns, path)
    scale = np.ldexp(np.float32(1), pixels[..., 3:].astype(np.int32) - 136)
    scale[pixels[..., 3:] == 0] = 0
    return pixels[..., :3].astype(np.float32) * scale


def _is_run_length(body: memoryview, columns: int) -> bool:
    return bytes(body[:4]) == bytes((2, 2, columns >> 8, columns & 255))


def _decode_runs(body: memoryview, rows: int, columns: int, path: Path) -> np.ndarray:
    lead = bytes((2, 2, columns >> 8 & 255, columns & 255))
    line = bytearray(4 * columns)
    pixels = np.empty((rows, columns, 4), np.uint8)
    at = 0
    for row in range(rows):
        if bytes(body[at : at + 4]) != lead:
            raise CaptureError(
                f"{path.name} is damaged at row {row}: expected a run-length scanline of {columns} pixels"
            )
        at += 4
        for channel in range(4):
            start, end = channel * columns, (channel + 1) * columns
            while start < end:
                if at + 1 >= len(body):
                    raise CaptureError(f"{path.name} is cut short at row {row} of {rows}")
                number = body[at]
                piece: bytes | memoryview
                if number > 128:
                    number -= 128
                    piece = bytes((body[at + 1],)) * number
                    at += 2
                else:
                    piece = body[at + 1 : at + 1 + number]
                    at += 1 + number
                if number == 0 or start + number > end or len(piece) != number:
                    raise CaptureError(
                        f"{path.name} is damaged at row {row}: a run leaves the scanline or the file"
                    )
                line[start : start + number] = piece
                start += number
        pixels[row] = np.frombuffer(line, np.uint8).reshape(4, columns).T
    return pixels
