"""Frames of an episode -> a video file, mp4 or gif, encoded as they come.

What a file needs beyond the base install is imported when one is begun: PyAV for mp4, Pillow for gif.
"""

import importlib
import math
import os
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import numpy as np

_PACKAGES = {".mp4": "av", ".gif": "PIL"}

_GIF_MOST_FRAMES_PER_SECOND = 15
_GIF_COLOURS = 64
_GIF_WIDTH = 320  # at most, where none is asked for


class VideoError(Exception):
    """No video can be made; the message says why and what to do."""


class Video:
    """A video in the making; used in a `with` block.

    The file is at `path` once the block has ended well, and nothing is if it raised. Whether it can be written shows
    at the block's beginning, before anything is played.
    """

    def __init__(self, path: Path, *, width: int | None = None, max_seconds: float | None = None) -> None:
        """`width` in pixels, the height follows: unset the frames' own, in a gif 320 at most.

        After `max_seconds` of video no more is recorded. Raises VideoError for a suffix that is not known and for a
        package that is missing.
        """
        if path.suffix.lower() not in _PACKAGES:
            raise VideoError(f"a video is written as {' or '.join(_PACKAGES)}, not as {path.name!r}")
        try:
            importlib.import_module(_PACKAGES[path.suffix.lower()])
        except ImportError as error:
            raise VideoError(f'{path.suffix} files need {error.name}: pip install "daedalus-rl[video]"') from None
        self.frames_per_second = 30.0  # of what `add` is given; the environment's own, to be set before the first
        self.frames = 0  # recorded
        self._path = path
        self._beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
        self._width, self._max_seconds = width, max_seconds
        self._shape: tuple[int, ...] = ()
        self._encoder: _Encoder | None = None

    def __enter__(self) -> "Video":
        if self._path.is_dir():
            raise VideoError(f"cannot write {self._path}: it is a directory")
        try:
            self._beside.touch()
        except OSError as error:
            raise self._refused(error) from None
        return self

    def add(self, frame: np.ndarray) -> None:
        """Records one frame [height, width, 3] uint8 RGB."""
        if self._max_seconds is not None and self.frames >= self._max_seconds * self.frames_per_second:
            return
        try:
            if self._encoder is None:
                self._encoder = self._begin(frame)
            if frame.shape != self._shape:
                raise VideoError(f"the frames change from {self._shape} to {frame.shape}; a video has one size")
            self._encoder.add(frame)
        except OSError as error:
            raise self._refused(error) from None
        self.frames += 1

    def _begin(self, frame: np.ndarray) -> "_Encoder":
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise VideoError(f"a video wants uint8 frames [height, width, 3], not {frame.dtype} of {frame.shape}")
        self._shape = frame.shape
        kind = Mp4Encoder if self._path.suffix.lower() == ".mp4" else GifEncoder
        return kind(self._beside, self.frames_per_second, frame.shape[1], frame.shape[0], self._width)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is not None:
                with suppress(Exception):  # the first error is the one to tell
                    self._close()
                return
            if not self._close():
                raise VideoError(f"cannot write {self._path}: the environment drew nothing")
            os.replace(self._beside, self._path)
        except OSError as refused:
            raise self._refused(refused) from None
        finally:
            self._beside.unlink(missing_ok=True)

    def _close(self) -> bool:
        """Ends the file; False if there was nothing to write."""
        if self._encoder is None:
            return False
        self._encoder.close()
        return True

    def _refused(self, error: OSError) -> VideoError:
        return VideoError(f"cannot write {self._path}: {error.strerror or error}")


class _Encoder(Protocol):
    """Writes frames of one size into a file."""

    def add(self, frame: np.ndarray) -> None: ...

    def close(self) -> None: ...


class Mp4Encoder:
    """H.264 as every player and browser takes it: yuv420p, even sizes, the index first."""

    def __init__(
        self, path: Path, frames_per_second: float, frame_width: int, frame_height: int, width: int | None
    ) -> None:
        import av

        width = width or frame_width
        self._size = [max(length // 2 * 2, 2) for length in (width, round(frame_height * width / frame_width))]
        self._av: Any = av
        # Absolute: a name with a colon in it would read as a protocol.
        self._container: Any = av.open(str(path.absolute()), "w", format="mp4", options={"movflags": "+faststart"})
        rate = Fraction(frames_per_second).limit_denominator(1000)
        self._stream: Any = self._container.add_stream("libx264", rate=rate)
        self._stream.width, self._stream.height = self._size
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"preset": "veryfast", "crf": "20"}

    def add(self, frame: np.ndarray) -> None:
        """Takes in one frame [height, width, 3] uint8 RGB."""
        picture = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), "rgb24")
        self._container.mux(self._stream.encode(picture.reformat(*self._size, "yuv420p")))

    def close(self) -> None:
        """Writes what the encoder still holds, and the index."""
        try:
            self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()


class GifEncoder:
    """A small endless gif: every n-th frame, each with its own palette, and of it only what changed.

    Pillow encodes each picture; the file around them is written here, as Pillow's own writer holds all of them.
    """

    def __init__(
        self, path: Path, frames_per_second: float, frame_width: int, frame_height: int, width: int | None
    ) -> None:
        width = width or min(frame_width, _GIF_WIDTH)
        self._size = width, max(round(frame_height * width / frame_width), 1)
        self._every = math.ceil(frames_per_second / _GIF_MOST_FRAMES_PER_SECOND)
        self._seconds = self._every / frames_per_second  # that each picture is shown
        self._taken = 0
        self._before: Any = None
        self._file = path.open("wb")
        screen = b"".join(length.to_bytes(2, "little") for length in self._size) + bytes(3)  # no common palette
        self._file.write(b"GIF89a" + screen + b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00")

    def add(self, frame: np.ndarray) -> None:
        """Takes in one frame [height, width, 3] uint8 RGB."""
        from PIL import GifImagePlugin, Image, ImageChops

        number, rest = divmod(self._taken, self._every)
        self._taken += 1
        if rest:
            return
        picture = Image.fromarray(frame).resize(self._size, Image.Resampling.BILINEAR)
        changed = (0, 0, *self._size)
        if self._before is not None:
            changed = ImageChops.difference(self._before, picture).getbbox() or (0, 0, 1, 1)
        self._before = picture
        part = picture.crop(changed).quantize(_GIF_COLOURS, dither=Image.Dither.NONE)
        # In hundredths of a second, as gif counts; the sum of them is kept exact.
        shown = round((number + 1) * self._seconds * 100) - round(number * self._seconds * 100)
        self._file.writelines(
            GifImagePlugin.getdata(part, changed[:2], duration=shown * 10, disposal=1, include_color_table=True)
        )

    def close(self) -> None:
        """Writes the end."""
        try:
            self._file.write(b";")
        finally:
            self._file.close()
