"""A few of the homes drawn from a seed, rendered at small cost: depth, glass, noise, mesh, files."""

from __future__ import annotations

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.config.sections import InputConfig
from mipsjax.data.synth import open_synth
from mipsjax.data.synth.__main__ import main
from mipsjax.data.synth.catalog import QVGA
from mipsjax.data.synth.home import home
from mipsjax.data.synth.home_plan import home_plan
from mipsjax.data.synth.mesh import reference_mesh
from mipsjax.data.synth.render import render
from mipsjax.metrics.surface import Views, observed

pytestmark = pytest.mark.slow

# A home of one room and of few shapes, and one of several rooms
SMALL_HOME, LARGE_HOME = 106, 105
NARROW = InputConfig(working_width=80)

distance = jax.jit(lambda scene, points: scene.distance(points))


@pytest.mark.parametrize("name", [f"home-{SMALL_HOME}", f"home-{LARGE_HOME}-fast"])
def test_most_pixels_have_depth_and_the_camera_is_in_free_space(name: str) -> None:
    sequence = open_synth(name, slice(None, None, 60), NARROW)
    assert sequence.T_world_cam is not None
    free = distance(sequence.scene, jnp.asarray(sequence.T_world_cam[:, :3, 3], jnp.float32))
    assert np.min(free) > 0.25
    measured = []
    for number in range(len(sequence)):
        frame = sequence[number]
        assert frame.depth is not None and frame.color is not None
        measured.append(np.mean(frame.depth > 0.0))
        assert frame.color.std() > 5.0
    assert np.median(measured) > 0.9 and np.quantile(measured, 0.1) > 0.6
    # Glass: some frames lack depth, and are bright there
    assert np.min(measured) < 0.99


def test_glass_has_no_depth_and_is_bright() -> None:
    """Towards the middle of a window, from 1.5 m."""
    plan = home_plan(SMALL_HOME)
    window = plan.windows[0]
    forward = np.zeros(3)
    forward[[0, 2][window.axis]] = window.outward
    right = np.cross([0.0, 1.0, 0.0], forward)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.stack([right, [0.0, 1.0, 0.0], forward], axis=1)
    middle = np.array([window.place[0], -(window.sill + window.height / 2), window.place[1]])
    # Beside the bar in the middle
    T_world_cam[:3, 3] = middle - 1.5 * forward + 0.25 * window.width * right
    image = render(home(SMALL_HOME), QVGA.resized(80, 60), T_world_cam[None])
    assert image.glass[30, 40] and not image.glass[58, 40]
    assert image.color[image.glass].mean() > 1.2 * image.color[~image.glass].mean()
    # The pane ends the ray: its own depth is known to the renderer
    assert image.depth[30, 40] == pytest.approx(1.7, abs=0.03)


def test_glass_is_no_part_of_what_was_seen() -> None:
    """So that the true mesh, culled to that, holds no panes; the middles of the wall below them are seen."""
    sequence = open_synth(f"home-{SMALL_HOME}", slice(None, None, 30), NARROW)
    assert sequence.T_world_cam is not None
    panes, walls = [], []
    for window in home_plan(SMALL_HOME).windows:
        across, along = (0, 2) if window.axis == 0 else (2, 0)
        point = np.array([window.place[0], -(window.sill + 0.5 * window.height), window.place[1]])
        point[along] += 0.25 * window.width
        walls.append(np.array([point[0], -0.8 * window.sill, point[2]]))
        point[across] += 0.19 * window.outward
        panes.append(point)
    depths = [frame.depth for frame in (sequence[n] for n in range(len(sequence))) if frame.depth is not None]
    views = Views(sequence.T_world_cam, sequence.intrinsics, depths)
    assert not observed(np.array(panes), views).any()
    assert observed(np.array(walls), views).any()


def test_noise_and_blur_take_glass() -> None:
    """The first frame that shows a pane far from its border: a camera in motion shows it a little elsewhere."""
    for start in range(0, 400, 20):
        sequence = open_synth(f"home-{SMALL_HOME}-fast+noise+blur", slice(start, start + 1), NARROW)
        assert sequence.T_world_cam is not None
        glass = render(home(SMALL_HOME), sequence.intrinsics, sequence.T_world_cam).glass.reshape(
            sequence.intrinsics.height, -1
        )
        inside = cv2.erode(glass.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        if inside.sum() > 20:
            break
    depth = sequence[0].depth
    assert inside.any() and depth is not None and not depth[inside].any()
    assert depth[~glass].any()


def test_the_true_mesh_is_made() -> None:
    mesh = reference_mesh(home(SMALL_HOME), voxel_m=0.12)
    off = np.abs(distance(home(SMALL_HOME), jnp.asarray(mesh.vertices, jnp.float32)))
    assert np.quantile(off, 0.98) < 1e-4


def test_export_of_a_home(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"home-{SMALL_HOME}"
    assert main([name, str(tmp_path / "home"), "--frames", ":2", "--no-mesh"]) == 0
    assert f"2 frames of synth:{name}" in capsys.readouterr().out
    assert '"fps": 15.0' in (tmp_path / "home" / "camera.json").read_text()
