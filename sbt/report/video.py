"""Writes pictures as a film: GIF and WebP by Pillow, MP4 and WebM by ffmpeg."""

from __future__ import annotations

import importlib
import importlib.util
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sbt.errors import InputError

__all__ = ["FORMATS", "check_format", "write_video"]

FORMATS = (".gif", ".webp", ".mp4", ".webm")
_BY_FFMPEG = {".mp4": ["-c:v", "libx264", "-movflags", "+faststart"], ".webm": ["-c:v", "libvpx-vp9", "-b:v", "0", "-crf", "32"]}


def check_format(file: Path) -> None:
    """Raise an error unless a film can be written under this name.

    Raises:
        InputError: the name ends in no known format, or ffmpeg is needed and not there.
    """
    suffix = file.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"a film's name must end in one of {', '.join(FORMATS)}, but got '{file}'")
    if suffix in _BY_FFMPEG and not _ffmpeg():
        raise InputError(f"a film as {suffix} needs ffmpeg, which is not there: pip install 'sumo-sbt[video]', or choose .gif")


def write_video(file: Path, images: Sequence[Any], milliseconds: Sequence[int]) -> None:
    """Write pictures as a film, each shown for its time.

    Args:
        file: to be written; its ending is the format.
        images: of Pillow, all of one size; they share a palette.
        milliseconds: time of each; all but the last are equal.
    """
    check_format(file)
    suffix = file.suffix.lower()
    if suffix == ".gif":
        more = {"optimize": True, "disposal": 1}
        images[0].save(file, save_all=True, append_images=images[1:], duration=list(milliseconds), loop=0, **more)
    elif suffix == ".webp":
        shown = [image.convert("RGB") for image in images]
        shown[0].save(file, save_all=True, append_images=shown[1:], duration=list(milliseconds), loop=0, lossless=True)
    else:
        _by_ffmpeg(file, images, milliseconds)


def _by_ffmpeg(file: Path, images: Sequence[Any], milliseconds: Sequence[int]) -> None:
    """Write a film whose pictures follow each other evenly; the last is repeated as long as it is shown."""
    file.open("wb").close()  # what the system says of it is clearer than what ffmpeg says
    width, height = images[0].size
    each = milliseconds[0]
    held = max(round(milliseconds[-1] / each), 1)
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{1000 / each:.6f}", "-i", "-"]
    even = ["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "-pix_fmt", "yuv420p"]  # what players take
    command = [_ffmpeg(), "-y", "-loglevel", "error", *given, "-an", *even, *_BY_FFMPEG[file.suffix.lower()], str(file)]
    data = b"".join(image.convert("RGB").tobytes() for image in [*images, *[images[-1]] * (held - 1)])
    done = subprocess.run(command, input=data, capture_output=True, check=False)
    if done.returncode:
        file.unlink(missing_ok=True)
        said = " ".join(done.stderr.decode(errors="replace").split())[-200:] or f"it ended with {done.returncode}"
        raise InputError(f"ffmpeg must be able to write {file.suffix} (or choose .gif), but: {said}")


def _ffmpeg() -> str:
    """Return the path of ffmpeg: of the system, or of the package imageio-ffmpeg; "" where there is none."""
    found = shutil.which("ffmpeg")
    if found is None and importlib.util.find_spec("imageio_ffmpeg") is not None:
        found = importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return found or ""
