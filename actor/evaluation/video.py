"""Video files, mp4 or gif, encoded frame by frame while an episode is played.

The encoders are optional packages, imported on first use: PyAV for mp4, Pillow for gif.
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

from daedalus.actor.environments.rendering import FrameRate

_PACKAGES = {".mp4": "av", ".gif": "PIL"}
FORMATS = tuple(_PACKAGES)

_GIF_MAX_FRAMES_PER_SECOND = 15
_GIF_COLOURS = 64
_GIF_WIDTH = 320  # the most, unless another width is asked for


class VideoError(Exception):
    """The video cannot be written; the message says why and what to do."""


class Video:
    """A video being recorded, as a context manager.

    The file appears at `path` when the block ends without an exception. A path that cannot be written raises VideoError
    when the block begins.
    """

    def __init__(self, path: Path, *, width: int | None = None, max_seconds: float | None = None) -> None:
        """Check that the format is supported.

        Args:
          path: ends with .mp4 or .gif.
          width: in pixels, the height follows; None: the width of the frames, in a gif at most 320.
          max_seconds: ignore all frames after so many seconds of video.

        Raises VideoError for an unknown suffix or a missing package.
        """
        if path.suffix.lower() not in _PACKAGES:
            raise VideoError(f"a video file must end with {' or '.join(FORMATS)}, unlike {path.name!r}")
        try:
            importlib.import_module(_PACKAGES[path.suffix.lower()])
        except ImportError as error:
            raise VideoError(f'{path.suffix} files need {error.name}: pip install "daedalus-rl[video]"') from None
        self.rate = FrameRate()  # of the frames
        self.frames = 0  # recorded so far
        self.seconds = 0.0  # that the video plays; known at the end of the block
        self._first: np.ndarray | None = None  # until the second one is there
        self._path = path
        # An absolute path: an environment may change the working directory before the first frame.
        self._partial = Path(os.path.abspath(path.with_name(f".{path.name}.{os.getpid()}.partial")))
        self._width, self._max_seconds = width, max_seconds
        self._shape: tuple[int, ...] = ()
        self._encoder: _Encoder | None = None

    def __enter__(self) -> "Video":
        if self._path.is_dir():
            raise VideoError(f"cannot write {self._path}: it is a directory")
        try:
            self._partial.unlink(missing_ok=True)  # it may be a link of somebody else
            self._partial.touch(exist_ok=False)
        except OSError as error:
            raise self._write_error(error) from None
        return self

    @property
    def is_full(self) -> bool:
        """Whether the video has its greatest length."""
        # Less a rounding error: 0.3 x 10 is more than 3.
        return self._max_seconds is not None and self.frames >= self._max_seconds * self.rate.per_second * (1 - 1e-9)

    def add(self, frame: np.ndarray, rate: FrameRate) -> None:
        """Record one frame [height, width, 3] uint8 RGB.

        The rate of the second one is that of all: a wrapper that skips frames has made no step at the first one.
        """
        if self.is_full:
            return
        if self._encoder is None:
            self.rate = rate
        try:
            if self._first is None:
                self._check(frame)
                self._first = frame.copy()  # a renderer may draw into it again
            elif self._encoder is None:
                self._encoder = self._begin(self._first)
            if frame.shape != self._shape:
                raise VideoError(
                    f"the frames change from {self._shape} to {frame.shape}: all frames of a video must have one size"
                )
            if self._encoder is not None:
                self._encoder.add(frame)
        except OSError as error:
            raise self._write_error(error) from None
        self.frames += 1

    def _check(self, frame: np.ndarray) -> None:
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise VideoError(f"the frames must be uint8 [height, width, 3], not {frame.dtype} of {frame.shape}")
        self._shape = frame.shape

    def _begin(self, first: np.ndarray) -> "_Encoder":
        kind = Mp4Encoder if self._path.suffix.lower() == ".mp4" else GifEncoder
        encoder = kind(self._partial, self.rate.per_second, first.shape[1], first.shape[0], self._width)
        encoder.add(first)
        return encoder

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is not None:
                with suppress(Exception):  # broad: the encoder may fail after any error; report the first one
                    self._close()
                return
            if not self._close():
                raise VideoError(f"cannot write {self._path}: no frame was recorded")
            os.replace(self._partial, self._partial.with_name(self._path.name))
        except OSError as failure:
            raise self._write_error(failure) from None
        finally:
            self._partial.unlink(missing_ok=True)

    def _close(self) -> bool:
        """End the file; return False if there is no frame in it."""
        if self._first is None:
            return False
        if self._encoder is None:
            self._encoder = self._begin(self._first)
        self.seconds = self._encoder.close()
        return True

    def _write_error(self, error: OSError) -> VideoError:
        return VideoError(f"cannot write {self._path}: {error.strerror or error}")


class _Encoder(Protocol):
    """A file that frames of one size are written to."""

    def add(self, frame: np.ndarray) -> None: ...

    def close(self) -> float:
        """End the file, and return how many seconds it plays."""
        ...


class Mp4Encoder:
    """An mp4 file that every player and browser supports: H.264, yuv420p, even sizes, the index first."""

    def __init__(
        self, path: Path, frames_per_second: float, frame_width: int, frame_height: int, width: int | None
    ) -> None:
        import av

        width = width or frame_width
        self._size = [max(length // 2 * 2, 2) for length in (width, round(frame_height * width / frame_width))]
        self._frames, self._frames_per_second = 0, frames_per_second
        self._av: Any = av
        # An absolute path: PyAV would read a relative one with a colon as a protocol.
        self._container: Any = av.open(str(path.absolute()), "w", format="mp4", options={"movflags": "+faststart"})
        rate = Fraction(frames_per_second).limit_denominator(1000)
        self._stream: Any = self._container.add_stream("libx264", rate=rate)
        self._stream.width, self._stream.height = self._size
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"preset": "veryfast", "crf": "20"}

    def add(self, frame: np.ndarray) -> None:
        """Encode one frame [height, width, 3] uint8 RGB."""
        picture = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), "rgb24")
        self._container.mux(self._stream.encode(picture.reformat(*self._size, "yuv420p")))
        self._frames += 1

    def close(self) -> float:
        """Write the frames that the encoder still holds, and the index. See _Encoder."""
        try:
            self._container.mux(self._stream.encode(None))
            return self._frames / self._frames_per_second
        finally:
            self._container.close()


class GifEncoder:
    """A small gif that loops: every n-th frame, each with its own palette and cropped to the pixels that changed.

    Pillow encodes each image. The file is written here, because Pillow's own writer keeps all images in memory.
    """

    def __init__(
        self, path: Path, frames_per_second: float, frame_width: int, frame_height: int, width: int | None
    ) -> None:
        width = width or min(frame_width, _GIF_WIDTH)
        self._size = width, max(round(frame_height * width / frame_width), 1)
        self._every = math.ceil(frames_per_second / _GIF_MAX_FRAMES_PER_SECOND)
        self._frames_per_second = frames_per_second
        self._added = 0
        self._previous: Any = None
        self._waiting: tuple[Any, tuple[int, int]] | None = None  # the newest image and its place: its end is unknown
        self._hundredths = 0  # of a second, of the images before it
        self._file = path.open("wb")
        screen = b"".join(length.to_bytes(2, "little") for length in self._size) + bytes(3)  # no global palette
        self._file.write(b"GIF89a" + screen + b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00")

    def add(self, frame: np.ndarray) -> None:
        """Encode one frame [height, width, 3] uint8 RGB."""
        from PIL import Image, ImageChops

        self._added += 1
        if (self._added - 1) % self._every:
            return
        self._write(self._added - 1)
        picture = Image.fromarray(frame).resize(self._size, Image.Resampling.BILINEAR)
        changed = (0, 0, *self._size)
        if self._previous is not None:
            changed = ImageChops.difference(self._previous, picture).getbbox() or (0, 0, 1, 1)
        self._previous = picture
        part = picture.crop(changed).quantize(_GIF_COLOURS, dither=Image.Dither.NONE)
        self._waiting = part, changed[:2]

    def _write(self, end: int) -> None:
        """Write the waiting image, which is shown until frame `end`."""
        from PIL import GifImagePlugin

        if self._waiting is None:
            return
        part, place = self._waiting
        # Durations are in hundredths of a second; rounding their sums keeps the total exact. Players show an image of
        # one hundredth for ten.
        shown = max(round(end * 100 / self._frames_per_second) - self._hundredths, 2)
        self._hundredths += shown
        options = {"duration": shown * 10, "disposal": 1, "include_color_table": True}
        self._file.writelines(GifImagePlugin.getdata(part, place, **options))

    def close(self) -> float:
        """Write the last image and the end of the file. See _Encoder."""
        try:
            self._write(self._added)
            self._file.write(b";")
            return self._hundredths / 100
        finally:
            self._file.close()
