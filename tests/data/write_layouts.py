"""Small sequences in every layout, written by the tests that read them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 64, 48
FRAMES = 5
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5}


def color_image(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Smooth RGB with red = frame number, so that JPEG keeps it recognisable."""
    image = np.empty((height, width, 3), np.uint8)
    image[..., 0] = 20 * number
    image[..., 1] = np.linspace(0, 200, width)
    image[..., 2] = np.linspace(0, 200, height)[:, None]
    return image


def depth_image(number: int, units: float = 1000.0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A wall at 2 m plus 1 cm a frame, without a measurement in the first row."""
    image = np.full((height, width), round((2.0 + 0.01 * number) * units), np.uint16)
    image[0] = 0
    return image


def pose(number: int) -> np.ndarray:
    """Camera-to-world: 2 cm and 1 degree a frame."""
    angle = np.radians(number)
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[0, 3] = 0.02 * number
    return matrix


def write_image(path: Path, image: np.ndarray) -> None:
    """Any image; three channels are RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = image[..., ::-1] if image.ndim == 3 else image
    assert cv2.imwrite(str(path), pixels)


def write_matrix(path: Path, matrix: np.ndarray) -> None:
    """A matrix as text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix)


def write_rows(path: Path, poses: list[np.ndarray]) -> None:
    """16 numbers a row."""
    np.savetxt(path, np.reshape(poses, (len(poses), 16)))


def write_folder(root: Path, numbers: range = range(FRAMES)) -> Path:
    """Our own layout."""
    for number in numbers:
        write_image(root / "color" / f"{number:06d}.jpg", color_image(number))
        write_image(root / "depth" / f"{number:06d}.png", depth_image(number))
    write_rows(root / "poses.txt", [pose(number) for number in numbers])
    (root / "camera.json").write_text(json.dumps(CAMERA | {"depth_scale": 1000.0, "fps": 10.0}))
    return root


def write_tum(root: Path, size: tuple[int, int] = (WIDTH, HEIGHT), offset: float = 0.01) -> Path:
    """TUM RGB-D with colour `offset` seconds before depth, and ground truth at 100 Hz."""
    lists: dict[str, list[str]] = {"rgb": ["# colour"], "depth": ["# depth"]}
    for number in range(FRAMES):
        time = 100.0 + number / 10
        for kind, stamp in (("rgb", time - offset), ("depth", time)):
            lists[kind].append(f"{stamp:.6f} {kind}/{stamp:.6f}.png")
        write_image(root / "rgb" / f"{time - offset:.6f}.png", color_image(number, *size))
        write_image(root / "depth" / f"{time:.6f}.png", depth_image(number, 5000.0, *size))
    for kind, lines in lists.items():
        (root / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    truth = [f"{99.995 + 0.01 * step:.6f} {step / 100} 0 0 0 0 0 1" for step in range(60)]
    (root / "groundtruth.txt").write_text("# ground truth\n" + "\n".join(truth) + "\n")
    return root


def write_replica(root: Path, frames: int = FRAMES) -> Path:
    """Replica, with `cam_params.json` one level up."""
    for number in range(frames):
        write_image(root / "results" / f"frame{number:06d}.jpg", color_image(number))
        write_image(root / "results" / f"depth{number:06d}.png", depth_image(number, 6553.5))
    write_rows(root / "traj.txt", [pose(number) for number in range(frames)])
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "scale": 6553.5}
    (root.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return root


def write_scannet(
    root: Path, suffix: str = ".jpg", color_size: tuple[int, int] = (130, 97), intrinsic: str = "color"
) -> Path:
    """ScanNet with larger colour, names 0, 2, ... 18 and an inf pose in frame 4."""
    for number in range(0, 20, 2):
        write_image(root / "color" / f"{number}{suffix}", color_image(number // 2, *color_size))
        write_image(root / "depth" / f"{number}.png", depth_image(number))
        write_matrix(
            root / "pose" / f"{number}.txt", np.full((4, 4), -np.inf) if number == 4 else pose(number)
        )
    if intrinsic:
        k = np.eye(4)
        k[0, 0], k[1, 1], k[0, 2], k[1, 2] = 117.0, 117.0, 64.5, 48.0
        write_matrix(root / "intrinsic" / f"intrinsic_{intrinsic}.txt", k)
    return root


def write_sevenscenes(root: Path, suffix: str = ".png", size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """7-Scenes with slightly skewed rotations and one saturated row."""
    for number in range(FRAMES):
        depth = depth_image(number, 1000.0, *size)
        depth[1] = 65535
        stem = f"frame-{number:06d}"
        write_image(root / f"{stem}.color{suffix}", color_image(number, *size))
        write_image(root / f"{stem}.depth.png", depth)
        matrix = pose(number)
        matrix[:3, :3] *= 1 + 4e-4
        write_matrix(root / f"{stem}.pose.txt", matrix)
    return root


def write_seq(path: Path, announced: int = FRAMES) -> Path:
    """A ROSEFusion `.seq` file."""
    with path.open("wb") as file:
        file.write(np.array([announced, HEIGHT, WIDTH], "<i4").tobytes())
        for number in range(FRAMES):
            file.write(depth_image(number).astype("<u2").tobytes())
            file.write(color_image(number)[..., ::-1].tobytes())
    return path
