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
        self.frames_per_second = 30.0  # of the frames given to `add`; set it before the first
        self.frames = 0  # recorded so far
        self._path = path
        self._partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
        self._width, self._max_seconds = width, max_seconds
        self._shape: tuple[int, ...] = ()
        self._encoder: _Encoder | None = None

    def __enter__(self) -> "Video":
        if self._path.is_dir():
            raise VideoError(f"cannot write {self._path}: it is a directory")
        try:
            self._partial.touch()
        except OSError as error:
            raise self._write_error(error) from None
        return self

    @property
    def is_full(self) -> bool:
        """Whether the video has its greatest length."""
        return self._max_seconds is not None and self.frames >= self._max_seconds * self.frames_per_second

    def add(self, frame: np.ndarray) -> None:
        """Record one frame [height, width, 3] uint8 RGB."""
        if self.is_full:
            return
        try:
            if self._encoder is None:
                self._encoder = self._begin(frame)
            if frame.shape != self._shape:
                raise VideoError(
                    f"the frames change from {self._shape} to {frame.shape}: all frames of a video must have one size"
                )
            self._encoder.add(frame)
        except OSError as error:
            raise self._write_error(error) from None
        self.frames += 1

    def _begin(self, frame: np.ndarray) -> "_Encoder":
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise VideoError(f"the frames must be uint8 [height, width, 3], not {frame.dtype} of {frame.shape}")
        self._shape = frame.shape
        kind = Mp4Encoder if self._path.suffix.lower() == ".mp4" else GifEncoder
        return kind(self._partial, self.frames_per_second, frame.shape[1], frame.shape[0], self._width)

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
            os.replace(self._partial, self._path)
        except OSError as failure:
            raise self._write_error(failure) from None
        finally:
            self._partial.unlink(missing_ok=True)

    def _close(self) -> bool:
        """End the file; return False if there is no frame in it."""
        if self._encoder is None:
            return False
        self._encoder.close()
        return True

    def _write_error(self, error: OSError) -> VideoError:
        return VideoError(f"cannot write {self._path}: {error.strerror or error}")


class _Encoder(Protocol):
    """A file that frames of one size are written to."""

    def add(self, frame: np.ndarray) -> None: ...

    def close(self) -> None: ...


class Mp4Encoder:
    """An mp4 file that every player and browser supports: H.264, yuv420p, even sizes, the index first."""

    def __init__(
        self, path: Path, frames_per_second: float, frame_width: int, frame_height: int, width: int | None
    ) -> None:
        import av

        width = width or frame_width
        self._size = [max(length // 2 * 2, 2) for length in (width, round(frame_height * width / frame_width))]
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

    def close(self) -> None:
        """Write the frames that the encoder still holds, and the index."""
        try:
            self._container.mux(self._stream.encode(None))
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
        self._seconds = self._every / frames_per_second  # duration of each image
        self._added = 0
        self._previous: Any = None
        self._file = path.open("wb")
        screen = b"".join(length.to_bytes(2, "little") for length in self._size) + bytes(3)  # no global palette
        self._file.write(b"GIF89a" + screen + b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00")

    def add(self, frame: np.ndarray) -> None:
        """Encode one frame [height, width, 3] uint8 RGB."""
        from PIL import GifImagePlugin, Image, ImageChops

        number, rest = divmod(self._added, self._every)
        self._added += 1
        if rest:
            return
        picture = Image.fromarray(frame).resize(self._size, Image.Resampling.BILINEAR)
        changed = (0, 0, *self._size)
        if self._previous is not None:
            changed = ImageChops.difference(self._previous, picture).getbbox() or (0, 0, 1, 1)
        self._previous = picture
        part = picture.crop(changed).quantize(_GIF_COLOURS, dither=Image.Dither.NONE)
        # Durations are in hundredths of a second; rounding their sums keeps the total exact.
        shown = round((number + 1) * self._seconds * 100) - round(number * self._seconds * 100)
        self._file.writelines(
            GifImagePlugin.getdata(part, changed[:2], duration=shown * 10, disposal=1, include_color_table=True)
        )

    def close(self) -> None:
        """Write the end of the file."""
        try:
            self._file.write(b";")
        finally:
            self._file.close()
