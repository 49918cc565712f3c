"""Bags of ROS 1 and 2: topics, encodings, times, the camera, and what is damaged."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from write_layouts import CAMERA, FRAMES, HEIGHT, WIDTH, color_image, depth_image

from mipsjax.data.imagesequence import ImageSequence
from mipsjax.data.open import open_sequence
from mipsjax.errors import InputError

DEPTH, COLOR, INFO = "/camera/depth/image_raw", "/camera/color/image_raw", "/camera/depth/camera_info"
RAW, PACKED, CAMERA_INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
START_S = 1_700_000_000
DELAY_NS = 30_000_000
"""From the moment of a frame until it is recorded."""


class Bag:
    """Writes the messages of a few frames."""

    def __init__(self, path: Path, ros: int = 1, plugin: StoragePlugin = StoragePlugin.SQLITE3) -> None:
        self.path, self.ros = path, ros
        self.types = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        self.messages: list[tuple[str, str, int, Any]] = []
        self.plugin = plugin

    def header(self, number: int, frame: str) -> Any:
        T = self.types.types
        stamp = T["builtin_interfaces/msg/Time"](
            sec=START_S + number // 10, nanosec=number % 10 * 100_000_000
        )
        more = {"seq": number} if self.ros == 1 else {}
        return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def add(self, topic: str, kind: str, number: int, frame: str = "camera", **fields: Any) -> None:
        message = self.types.types[kind](header=self.header(number, frame), **fields)
        self.messages.append((topic, kind, START_S * 10**9 + number * 10**8 + DELAY_NS, message))

    def image(
        self, topic: str, number: int, pixels: np.ndarray, encoding: str, frame: str = "camera"
    ) -> None:
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        big = int(pixels.dtype.byteorder == ">")
        height, width = pixels.shape[:2]
        step = data.size // height
        size = {"height": height, "width": width, "step": step}
        self.add(topic, RAW, number, frame, **size, encoding=encoding, is_bigendian=big, data=data)

    def packed(self, topic: str, number: int, data: bytes, how: str) -> None:
        self.add(topic, PACKED, number, format=how, data=np.frombuffer(data, np.uint8))

    def info(
        self, topic: str = INFO, distortion: tuple[float, ...] = (0.0,) * 5, fx: float = CAMERA["fx"]
    ) -> None:
        T = self.types.types
        matrix = np.array([fx, 0, CAMERA["cx"], 0, CAMERA["fy"], CAMERA["cy"], 0, 0, 1.0])
        projection = np.insert(matrix.reshape(3, 3), 3, 0, axis=1).ravel() + np.eye(1, 12).ravel()
        fields = {"D": np.array(distortion), "K": matrix, "R": np.eye(3).ravel(), "P": projection}
        if self.ros == 2:
            fields = {name.lower(): value for name, value in fields.items()}
        roi = T["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        size = {"height": HEIGHT, "width": WIDTH, "binning_x": 0, "binning_y": 0}
        self.add(topic, CAMERA_INFO, 0, **size, roi=roi, distortion_model="plumb_bob", **fields)

    def frames(self, depth: str = DEPTH, color: str = COLOR) -> None:
        for number in range(FRAMES):
            self.image(depth, number, depth_image(number), "16UC1")
            self.image(color, number, color_image(number), "rgb8")

    def write(self) -> Path:
        writer = (
            Writer1(self.path) if self.ros == 1 else Writer2(self.path, version=9, storage_plugin=self.plugin)
        )
        with writer:
            connections = {}
            for topic, kind, when, message in sorted(self.messages, key=lambda entry: entry[2]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.types)
                one = self.types.serialize_ros1 if self.ros == 1 else self.types.serialize_cdr
                writer.write(connections[topic], when, one(message, kind))
        return self.path


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def opened(path: Path, **options: Any) -> ImageSequence:
    sequence = open_sequence(path, **options)
    assert isinstance(sequence, ImageSequence) and sequence.layout == "bag"
    return sequence


def check_frames(sequence: ImageSequence, tolerance_m: float = 0.0) -> None:
    """All frames are those of `write_layouts`, at the times of their headers."""
    assert len(sequence) == FRAMES
    np.testing.assert_allclose(sequence.timestamps, START_S + 0.1 * np.arange(FRAMES), atol=1e-6)
    for number in range(FRAMES):
        frame = sequence[number]
        assert not frame.problem and frame.color is not None and frame.depth is not None
        np.testing.assert_array_equal(frame.color, color_image(number))
        np.testing.assert_allclose(frame.depth, depth_image(number) / 1000, rtol=1e-6, atol=tolerance_m)


@pytest.mark.parametrize("kind", ["bag", "folder", "mcap", "db3"])
def test_bags_of_both_kinds(tmp_path, kind):
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    bag = Bag(tmp_path / ("scene.bag" if kind == "bag" else "scene"), 1 if kind == "bag" else 2, plugin)
    bag.frames()
    bag.info()
    path = bag.write()
    if kind in ("mcap", "db3"):
        (path,) = path.glob(f"*.{kind}")
    sequence = opened(path)
    check_frames(sequence)
    assert sequence.intrinsics[:4] == (60.0, 61.0, 31.5, 23.5)
    assert f"depth from {DEPTH}, colour from {COLOR}" in sequence.notes


@pytest.mark.parametrize("encoding", ["bgr8", "rgba8", "bgra8", "png"])
@pytest.mark.parametrize("depth", ["32FC1", "big", "16UC1 PNG", "32FC1 PNG"])
def test_encodings(tmp_path, encoding, depth):
    bag = Bag(tmp_path / "scene.bag")
    bag.info()
    for number in range(FRAMES):
        rgb, mm = color_image(number), depth_image(number)
        alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
        if encoding == "png":
            bag.packed(COLOR + "/compressed", number, png(rgb[..., ::-1]), "rgb8; png compressed bgr8")
        else:
            colored = rgb if encoding.startswith("rgb") else rgb[..., ::-1]
            with_alpha = colored if len(encoding) == 4 else np.concatenate([colored, alpha], -1)
            bag.image(COLOR, number, with_alpha, encoding)
        if depth == "32FC1":
            bag.image(DEPTH, number, np.where(mm > 0, mm / 1000, np.nan).astype(np.float32), "32FC1")
        elif depth == "big":
            bag.image(DEPTH, number, mm.astype(">u2"), "16UC1")
        elif depth == "16UC1 PNG":
            data = struct.pack("<iff", 0, 0.0, 0.0) + png(mm)
            bag.packed(DEPTH + "/compressedDepth", number, data, "16UC1; compressedDepth png")
        else:
            a, b = 1e4, 1.0
            whole = np.where(mm > 0, np.round(a / np.maximum(mm, 1) * 1000 + b), 0).astype(np.uint16)
            data = struct.pack("<iff", 0, a, b) + png(whole)
            bag.packed(DEPTH + "/compressedDepth", number, data, "32FC1; compressedDepth png")
    # Inverse depth in whole numbers, of which 5000 stand for 2 m
    check_frames(opened(bag.write()), 0.3e-3 if depth == "32FC1 PNG" else 0.0)


def test_raw_images_are_taken_before_the_same_ones_compressed(tmp_path):
    bag = Bag(tmp_path / "scene.bag")
    bag.frames()
    bag.info()
    for number in range(FRAMES):
        bag.packed(COLOR + "/compressed", number, png(color_image(number)), "jpeg")
        bag.packed(DEPTH + "/compressed", number, png(depth_image(number)), "16UC1; png compressed ")
        bag.image("/camera/infra1/image", number, color_image(number)[..., 1], "mono8")
    check_frames(opened(bag.write()))


@pytest.mark.fault(56)
def test_a_bag_without_depth(tmp_path):
    bag = Bag(tmp_path / "scene.bag")
    bag.info()
    for number in range(FRAMES):
        bag.image(COLOR, number, color_image(number), "rgb8")
    with pytest.raises(InputError, match="no topic of depth images; --depth-topic names one of") as caught:
        opened(bag.write())
    assert f"{COLOR} ({RAW}, {FRAMES} messages), {INFO} ({CAMERA_INFO}, 1 messages)" in str(caught.value)


@pytest.mark.fault(56)
def test_a_bag_with_several_topics_of_depth(tmp_path):
    bag, aligned = Bag(tmp_path / "scene.bag"), "/camera/aligned_depth/image"
    bag.frames()
    bag.info()
    for number in range(FRAMES):
        bag.image(aligned, number, depth_image(number), "16UC1")
    path = bag.write()
    with pytest.raises(InputError, match="several topics of depth; --depth-topic names one of") as caught:
        opened(path)
    assert all(f"{name} ({RAW}, {FRAMES} messages)" in str(caught.value) for name in (DEPTH, aligned))
    assert f"depth from {aligned}, colour from {COLOR}" in opened(path, depth_topic=aligned).notes
    with pytest.raises(InputError, match="has no images at /nothing"):
        opened(path, depth_topic="/nothing")
    with pytest.raises(InputError, match="depth must be 16-bit"):
        opened(path, depth_topic=COLOR)
    with pytest.raises(InputError, match=f"has no images at {INFO}"):
        opened(path, depth_topic=INFO)


def test_where_the_camera_is_from(tmp_path):
    bag = Bag(tmp_path / "raw.bag")
    bag.frames()
    path = bag.write()
    with pytest.raises(
        InputError, match="no topic of sensor_msgs/msg/CameraInfo that can be read; pass --intrinsics"
    ):
        opened(path)
    assert opened(path, intrinsics=(50, 50, 31, 23)).intrinsics.fx == 50
    bag = Bag(tmp_path / "distorted.bag")
    bag.frames()
    bag.info("/camera/color/camera_info", fx=80.0)
    bag.info(distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    distorted = opened(bag.write())
    assert distorted.calibration.distortion == (0.1, 0.0, 0.0, 0.0, 0.0) and distorted.calibration.fx == 60
    bag = Bag(tmp_path / "rectified.bag")
    bag.frames(depth="/camera/depth/image_rect_raw")
    bag.info(distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    rectified = opened(bag.write())
    assert rectified.calibration.distortion == () and rectified.calibration.fx == 61  # of the projection
    bag = Bag(tmp_path / "never.bag")
    bag.frames()
    bag.info(fx=0.0)
    with pytest.raises(InputError, match="not calibrated; pass --intrinsics"):
        opened(bag.write())


def test_colour_of_another_camera_and_images_without_partner_are_remarked_on(tmp_path):
    bag = Bag(tmp_path / "scene.bag")
    bag.info()
    for number in range(FRAMES):
        bag.image(DEPTH, number, depth_image(number), "16UC1", "depth")
        if number:
            bag.image(COLOR, number, color_image(number), "rgb8", "color")
    notes = "\n".join(opened(bag.write()).notes)
    assert "depth is of 'depth' and colour of 'color'" in notes
    assert f"{FRAMES - 1} pairs of {FRAMES - 1} colour and {FRAMES} depth images" in notes


def test_a_damaged_message_is_a_bad_frame(tmp_path):
    bag = Bag(tmp_path / "scene.bag")
    bag.info()
    for number in range(FRAMES):
        bag.image(COLOR, number, color_image(number), "rgb8")
        data = struct.pack("<iff", 0, 0.0, 0.0) + png(depth_image(number))
        data = data[:-40] if number == 2 else data
        bag.packed(DEPTH + "/compressedDepth", number, data, "16UC1; compressedDepth png")
    sequence = opened(bag.write())
    assert [bool(sequence[i].problem) for i in range(FRAMES)] == [i == 2 for i in range(FRAMES)]
    assert sequence[2].problem.startswith("unreadable_depth: message: truncated PNG")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("ros", [1, 2])
def test_a_bag_that_is_cut_is_refused_in_one_line(tmp_path, ros, share):
    bag = Bag(tmp_path / ("scene.bag" if ros == 1 else "scene"), ros, StoragePlugin.MCAP)
    bag.frames()
    bag.info()
    path = bag.write()
    if ros == 2:
        (path,) = path.glob("*.mcap")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        opened(path)
    assert "cannot be read as a ROS bag" in str(caught.value) and "\n" not in str(caught.value)


def test_without_the_package_it_is_said_how_to_get_it(tmp_path, monkeypatch):
    bag = Bag(tmp_path / "scene.bag")
    bag.frames()
    path = bag.write()
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match="pip install 'mipsjax\\[bags\\]'"):
        opened(path)


def test_topics_mean_nothing_elsewhere(tmp_path):
    from write_layouts import write_folder

    sequence = open_sequence(write_folder(tmp_path / "scene"), depth_topic="/depth")
    assert "--depth-topic left out" in "".join(sequence.notes)


def test_messages_of_one_moment_are_told_apart(tmp_path):
    """As where a clock of a simulation stands between two frames."""
    bag = Bag(tmp_path / "scene.bag")
    bag.frames()
    bag.info()
    bag.messages = [(topic, kind, START_S * 10**9, message) for topic, kind, _, message in bag.messages]
    check_frames(opened(bag.write()))


def test_without_a_clock_frames_have_the_times_at_which_they_were_recorded(tmp_path):
    bag = Bag(tmp_path / "scene.bag")
    bag.frames()
    bag.info()
    for _, _, _, message in bag.messages:
        message.header.stamp.sec = message.header.stamp.nanosec = 0
    times = opened(bag.write()).timestamps
    np.testing.assert_allclose(times, START_S + 0.1 * np.arange(FRAMES) + DELAY_NS * 1e-9, atol=1e-6)


def test_distortion_that_opencv_does_not_know_is_said(tmp_path):
    bag = Bag(tmp_path / "scene.bag")
    bag.frames()
    bag.info(distortion=(0.1, 0.2, 0.3))
    sequence = opened(bag.write())
    assert sequence.calibration.distortion == () and "is not undone" in "".join(sequence.notes)


@pytest.mark.parametrize("encoding", ["yuyv", "bayer_rggb8"])
def test_colours_that_pixels_share(tmp_path, encoding):
    """Of a grey image."""
    bag, grey = Bag(tmp_path / "scene.bag"), np.full((HEIGHT, WIDTH, 2), 128, np.uint8)
    bag.info()
    for number in range(FRAMES):
        bag.image(DEPTH, number, depth_image(number), "16UC1")
        bag.image(COLOR, number, grey if encoding == "yuyv" else grey[..., 0], encoding)
    color = opened(bag.write())[0].color
    assert color is not None and np.ptp(color) < 8 and abs(int(color[0, 0, 0]) - 128) < 8
