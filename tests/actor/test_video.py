"""Video: the file has the recorded frames, or there is no file."""

import sys
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from daedalus.actor.environments.rendering import FrameRate
from daedalus.actor.evaluation.video import Video, VideoError

FILES = ["film.mp4", "film.gif"]


def frame(number: int, height: int = 40, width: int = 60) -> np.ndarray:
    """A red square on blue that moves to the right by four pixels a frame."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[..., 2] = 200
    picture[16:24, 4 * number % (width - 8) : 4 * number % (width - 8) + 8] = 250, 0, 0
    return picture


def record(path: Path, frames: int, frames_per_second: float, **options: float) -> Video:
    with Video(path, **options) as video:  # type: ignore[arg-type] - width is an int
        for number in range(frames):
            video.add(frame(number), FrameRate(frames_per_second))
    return video


def read_mp4(path: Path) -> tuple[list[np.ndarray], float]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        pictures = [picture.to_ndarray(format="rgb24") for picture in container.decode(video=0)]
        assert stream.average_rate is not None
        return pictures, float(stream.average_rate)


def read_gif(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """The images of a gif, and their durations in milliseconds."""
    pictures, shown = [], []
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        for number in range(getattr(image, "n_frames", 1)):
            image.seek(number)
            pictures.append(np.asarray(image.convert("RGB")))
            shown.append(image.info["duration"])
    return pictures, shown


def test_mp4_has_every_frame_at_its_own_rate(tmp_path: Path) -> None:
    assert record(tmp_path / "film.mp4", 75, 50).frames == 75
    pictures, rate = read_mp4(tmp_path / "film.mp4")
    assert rate == 50
    assert len(pictures) == 75
    for number, picture in enumerate(pictures):
        assert np.abs(picture.astype(int) - frame(number)).mean() < 12  # colours are stored at half the resolution


@pytest.mark.parametrize(
    ("name", "given", "size"), [("film.mp4", (41, 61), (40, 60)), ("film.gif", (400, 640), (200, 320))]
)
def test_mp4_has_even_sizes_a_gif_is_small_and_both_have_a_width_that_is_given(
    tmp_path: Path, name: str, given: tuple[int, int], size: tuple[int, int]
) -> None:
    read = read_mp4 if name.endswith("mp4") else read_gif
    with Video(tmp_path / name) as video:
        video.add(frame(0, *given), FrameRate())
    assert read(tmp_path / name)[0][0].shape == (*size, 3)
    record(tmp_path / f"small-{name}", 2, 30, width=30)
    assert read(tmp_path / f"small-{name}")[0][0].shape == (20, 30, 3)


@pytest.mark.parametrize(
    ("rate", "frames", "kept", "milliseconds"),
    [(50, 100, range(0, 100, 4), 2000), (30, 60, range(0, 60, 2), 2000), (12, 24, range(24), 2000)],
)
def test_gif_keeps_every_nth_frame_and_the_total_duration(
    tmp_path: Path, rate: int, frames: int, kept: range, milliseconds: int
) -> None:
    record(tmp_path / "film.gif", frames, rate)
    pictures, shown = read_gif(tmp_path / "film.gif")
    assert sum(shown) == milliseconds
    assert len(pictures) == len(kept)
    for picture, number in zip(pictures, kept, strict=True):
        np.testing.assert_array_equal(picture, frame(number))


def test_gif_stores_only_the_pixels_that_change(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 3), np.uint8)
    with Video(tmp_path / "film.gif") as video:
        for number in range(10):
            noise[:8, :8] = 25 * number
            video.add(noise, FrameRate(15))
        for _ in range(10):
            video.add(noise, FrameRate(15))
    pictures, _ = read_gif(tmp_path / "film.gif")
    assert len(pictures) == 20
    assert (pictures[15][:8, :8] == 225).all()
    with Video(tmp_path / "still.gif") as video:
        video.add(noise, FrameRate())
    still = (tmp_path / "still.gif").stat().st_size
    assert (tmp_path / "film.gif").stat().st_size < still + 19 * 500


@pytest.mark.parametrize("name", FILES)
def test_recording_ends_after_max_seconds(tmp_path: Path, name: str) -> None:
    assert record(tmp_path / name, 60, 30, max_seconds=0.5).frames == 15
    assert record(tmp_path / f"rounded-{name}", 60, 10, max_seconds=0.3).frames == 3
    if name.endswith("mp4"):
        assert len(read_mp4(tmp_path / name)[0]) == 15
    else:
        assert sum(read_gif(tmp_path / name)[1]) == 500


@pytest.mark.parametrize(
    ("frames", "rate"), [(1, 125), (2, 125), (5, 50), (77, 125), (60, 29.97), (3, 0.5), (40, 5000)]
)
def test_video_plays_as_long_as_its_frames(tmp_path: Path, frames: int, rate: float) -> None:
    assert record(tmp_path / "film.mp4", frames, rate).seconds == pytest.approx(frames / rate)
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert container.duration is not None
        assert container.duration / 1e6 == pytest.approx(frames / rate, rel=0.01)
    film = record(tmp_path / "film.gif", frames, rate)
    shown = read_gif(tmp_path / "film.gif")[1]
    assert sum(shown) == pytest.approx(film.seconds * 1000)
    assert film.seconds == pytest.approx(frames / rate, abs=0.02)
    assert min(shown) >= 20  # browsers show an image of 10 ms for 100


@pytest.mark.parametrize("name", FILES)
def test_rate_of_the_second_frame_is_that_of_the_video(tmp_path: Path, name: str) -> None:
    with Video(tmp_path / name) as video:
        video.add(frame(0), FrameRate(60))
        for number in range(1, 20):
            video.add(frame(number), FrameRate(10))
    assert video.seconds == 2


@pytest.mark.parametrize("name", FILES)
def test_exception_leaves_no_file_and_keeps_an_earlier_one(tmp_path: Path, name: str) -> None:
    def fail() -> None:
        with Video(tmp_path / name) as video:
            for number in range(40):
                video.add(frame(number), FrameRate())
            raise RuntimeError("the engine stalled")

    with pytest.raises(RuntimeError, match="stalled"):
        fail()
    assert not list(tmp_path.iterdir())
    (tmp_path / name).write_text("precious")
    with pytest.raises(RuntimeError, match="stalled"):
        fail()
    assert [entry.read_text() for entry in tmp_path.iterdir()] == ["precious"]


@pytest.mark.parametrize("name", FILES)
def test_frames_are_written_while_recording(tmp_path: Path, name: str) -> None:
    random = np.random.default_rng(1)
    with Video(tmp_path / name) as video:
        for _ in range(150):
            video.add(random.integers(0, 256, (100, 100, 3), np.uint8), FrameRate(10))
        (beside,) = tmp_path.iterdir()
        written = beside.stat().st_size
    assert written > (tmp_path / name).stat().st_size / 4


@pytest.mark.parametrize("name", FILES)
def test_invalid_frames_are_reported(tmp_path: Path, name: str) -> None:
    def write(*frames: np.ndarray) -> None:
        with Video(tmp_path / name) as video:
            for picture in frames:
                video.add(picture, FrameRate())

    with pytest.raises(VideoError, match="no frame was recorded"):
        write()
    with pytest.raises(VideoError, match=r"from \(40, 60, 3\) to \(20, 60, 3\)"):
        write(frame(0), frame(0, 20))
    with pytest.raises(VideoError, match=r"not float64 of \(4, 4\)"):
        write(np.zeros((4, 4)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", FILES)
def test_path_that_cannot_be_written_raises_when_the_block_begins(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / name).mkdir()
    for place in (tmp_path / "nowhere" / name, tmp_path / "file" / name, tmp_path / name):
        with pytest.raises(VideoError, match=f"cannot write {place}: "), Video(place):
            raise AssertionError("the block was entered")


@pytest.mark.parametrize(("name", "package"), [("film.mp4", "av"), ("film.gif", "PIL")])
def test_unknown_suffix_and_missing_package_is_reported_with_the_extra_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    with pytest.raises(VideoError, match=r"must end with \.mp4 or \.gif, unlike 'film.avi'"):
        Video(tmp_path / "film.avi")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(VideoError, match=rf'need {package}: pip install "daedalus-rl\[video\]"'):
        Video(tmp_path / name)
