"""Images: damage becomes a reason, never an exception; depth in metres with 0 for no measurement."""

from __future__ import annotations

import os
import struct
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from write_layouts import color_image, depth_image, write_image

from mipsjax.data.images import (
    ImageHeader,
    depth_to_metres,
    find_damage,
    parse_header,
    read_color,
    read_header,
    read_raw_depth,
)
from mipsjax.errors import InputError


@pytest.fixture
def depth_png(tmp_path: Path) -> Path:
    path = tmp_path / "depth image ü.png"
    ok, data = cv2.imencode(".png", depth_image(1) + np.arange(64, dtype=np.uint16))
    assert ok
    path.write_bytes(data.tobytes())
    return path


@pytest.fixture
def color_jpg(tmp_path: Path) -> Path:
    write_image(tmp_path / "color.jpg", color_image(3))
    return tmp_path / "color.jpg"


def test_color_is_rgb(tmp_path: Path) -> None:
    write_image(tmp_path / "color.png", color_image(3))
    color, reason = read_color(tmp_path / "color.png")
    assert reason == "" and color is not None
    np.testing.assert_array_equal(color, color_image(3))


def test_depth_keeps_all_16_bits(depth_png: Path) -> None:
    depth, reason = read_raw_depth(depth_png)
    assert reason == "" and depth is not None and depth.dtype == np.uint16
    np.testing.assert_array_equal(depth, depth_image(1) + np.arange(64, dtype=np.uint16))


def test_gray_color_becomes_rgb(tmp_path: Path) -> None:
    write_image(tmp_path / "gray.png", color_image(3)[..., 1])
    color, _ = read_color(tmp_path / "gray.png")
    assert color is not None and color.shape == (48, 64, 3)


@pytest.mark.parametrize(("reader", "kind"), [(read_color, "color"), (read_raw_depth, "depth")])
def test_missing_file(tmp_path: Path, reader, kind: str) -> None:
    assert reader(tmp_path / "none.png") == (None, f"missing_{kind}: none.png")


@pytest.mark.parametrize("content", [b"", b"no image at all"], ids=["empty", "text"])
@pytest.mark.parametrize(("reader", "kind"), [(read_color, "color"), (read_raw_depth, "depth")])
def test_not_an_image(tmp_path: Path, reader, kind: str, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    image, reason = reader(tmp_path / "a.png")
    assert image is None and reason.startswith(f"unreadable_{kind}: a.png")


def test_a_folder_in_place_of_an_image(tmp_path: Path) -> None:
    assert read_raw_depth(tmp_path)[1].startswith("unreadable_depth")


@given(cut=st.floats(0, 0.999))
@pytest.mark.fault(7)
def test_any_truncated_png_is_damaged(cut: float) -> None:
    data = cv2.imencode(".png", depth_image(0))[1].tobytes()
    assert find_damage(data) == ""
    damaged = data[: int(cut * len(data))]
    assert find_damage(damaged) or not damaged.startswith(b"\x89PNG\r\n\x1a\n")


@given(place=st.integers(8, 10_000), bit=st.integers(0, 7))
@pytest.mark.fault(8)
def test_any_flipped_bit_of_a_png_is_damage(place: int, bit: int) -> None:
    data = bytearray(cv2.imencode(".png", depth_image(0))[1].tobytes())
    data[8 + place % (len(data) - 8)] ^= 1 << bit
    assert find_damage(bytes(data))


def test_damaged_png_is_no_depth(depth_png: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(depth_png.read_bytes())
    data[len(data) // 2] ^= 4
    depth_png.write_bytes(bytes(data))
    depth, reason = read_raw_depth(depth_png)
    assert depth is None and "checksum" in reason
    assert capfd.readouterr().err == ""  # libpng would complain there


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.999])
@pytest.mark.fault(9)
def test_truncated_jpeg_is_found(color_jpg: Path, part: float) -> None:
    data = color_jpg.read_bytes()
    color_jpg.write_bytes(data[: int(part * len(data))])
    color, reason = read_color(color_jpg)
    assert color is None and reason == "unreadable_color: color.jpg: truncated JPEG"


def test_nothing_is_printed_of_a_damaged_jpeg(color_jpg: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(color_jpg.read_bytes())
    scan = data.index(b"\xff\xda")
    # No marker, so that it is found only when it is decoded
    data[scan + 20 : scan + 60] = bytes(range(40))
    color_jpg.write_bytes(bytes(data))
    color, _ = read_color(color_jpg)
    assert color is not None and capfd.readouterr().err == ""
    print("after", file=sys.stderr)
    assert capfd.readouterr().err == "after\n"


def test_jpeg_thumbnail_does_not_hide_truncation(color_jpg: Path) -> None:
    data = color_jpg.read_bytes()
    thumbnail = b"\xff\xe1" + (2 + len(data)).to_bytes(2, "big") + data
    whole = data[:2] + thumbnail + data[2:]
    assert find_damage(whole) == ""
    assert find_damage(whole[:-20]) == "truncated JPEG"
    assert parse_header(whole) == ImageHeader(64, 48, 8, 3)


def test_jpeg_with_bytes_after_its_end_is_whole(color_jpg: Path) -> None:
    assert find_damage(color_jpg.read_bytes() + b"\0\0\0") == ""


def test_orientation_tag_is_ignored(color_jpg: Path) -> None:
    # EXIF with one entry, orientation = 6 (a quarter turn), which OpenCV applies by default.
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0" + b"\0\0\0\0"
    segment = b"Exif\0\0" + tiff
    data = color_jpg.read_bytes()
    turned = data[:2] + b"\xff\xe1" + (2 + len(segment)).to_bytes(2, "big") + segment + data[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (64, 48, 3)
    color_jpg.write_bytes(turned)
    color, _ = read_color(color_jpg)
    assert color is not None and color.shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("shape", "dtype"), [((48, 64), np.uint8), ((48, 64, 3), np.uint8), ((48, 64, 3), np.uint16)]
)
def test_depth_of_another_type_is_an_error(tmp_path: Path, shape: tuple[int, ...], dtype: type) -> None:
    write_image(tmp_path / "d.png", np.ones(shape, dtype))
    with pytest.raises(InputError, match=r"d\.png: depth must be 16-bit single channel"):
        read_raw_depth(tmp_path / "d.png")


def test_headers(depth_png: Path, color_jpg: Path, tmp_path: Path) -> None:
    assert read_header(depth_png) == ImageHeader(64, 48, 16, 1)
    assert read_header(color_jpg) == ImageHeader(64, 48, 8, 3)
    assert read_header(tmp_path / "none.png") is None


@given(st.binary(max_size=200), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8"]))
def test_any_bytes_have_a_header_or_none(data: bytes, start: bytes) -> None:
    header = parse_header(start + data)
    assert header is None or isinstance(header, ImageHeader)
    assert isinstance(find_damage(start + data), str)


@pytest.mark.fault(16)
def test_invalid_depth_becomes_zero() -> None:
    metres = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, 0.05, 9.0, 2.5]], np.float32)
    np.testing.assert_array_equal(
        depth_to_metres(metres, 1.0, 0.1, 8.0), np.array([[0, 0, 0, 0, 0, 0, 0, 2.5]], np.float32)
    )


@pytest.mark.fault(17)
def test_sensor_codes_are_no_depth_at_any_scale() -> None:
    raw = np.array([[0, 65535, 65534]], np.uint16)
    np.testing.assert_array_equal(depth_to_metres(raw, 65534.0, 0.0, np.inf), [[0, 0, 1]])


@given(
    hnp.arrays(np.float32, (3, 4), elements=st.floats(width=32)),
    st.floats(1e-3, 1e4),
)
def test_depth_is_in_range_or_zero(raw: np.ndarray, units: float) -> None:
    depth = depth_to_metres(raw, units, 0.1, 8.0)
    assert depth.dtype == np.float32
    assert np.all((depth == 0) | ((depth >= np.float32(0.1)) & (depth <= 8)))


@pytest.mark.parametrize(("reader", "kind"), [(read_color, "color"), (read_raw_depth, "depth")])
def test_only_regular_files_of_a_possible_size_are_read(tmp_path: Path, reader, kind: str) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "forged.png").write_bytes(with_size(16384, 16384))
    (tmp_path / "bitmap.png").write_bytes(cv2.imencode(".bmp", color_image(0))[1].tobytes())
    expected = {
        "pipe.png": "no regular file",
        "forged.png": "16384 x 16384 pixels",
        "bitmap.png": "neither PNG nor JPEG",
        "nul\0.png": "no name of a file",
    }
    for name, reason in expected.items():
        image, found = reader(tmp_path / name)
        assert image is None and found.startswith(f"unreadable_{kind}") and reason in found
    assert read_header(tmp_path / "pipe.png") is None and read_header(tmp_path / "nul\0.png") is None
    assert "no regular file" in reader(Path("/dev/zero"))[1]


@pytest.mark.parametrize("size", [(0, 48), (64, 0)])
def test_an_image_without_pixels_has_no_header(size: tuple[int, int]) -> None:
    assert parse_header(with_size(*size)) is None


def with_size(width: int, height: int) -> bytes:
    """A PNG whose header claims a size, with the checksum of the claim."""
    data = bytearray(cv2.imencode(".png", depth_image(0))[1].tobytes())
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def test_what_is_no_pixel_is_left_out_before_libpng_complains(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    data = cv2.imencode(".png", depth_image(0))[1].tobytes()
    profile = b"iCCPbroken\0\0no profile"
    chunk = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    (tmp_path / "a.png").write_bytes(data[:33] + chunk + data[33:])
    depth, reason = read_raw_depth(tmp_path / "a.png")
    assert depth is not None and reason == ""
    np.testing.assert_array_equal(depth, depth_image(0))
    assert capfd.readouterr().err == ""
