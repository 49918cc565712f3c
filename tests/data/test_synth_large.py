"""The larger synthetic scenes: what a walk through them meets, sees and can be tracked by; culling, mesh."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.config.sections import InputConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.data.synth import open_synth
from mipsjax.data.synth.apartment import apartment
from mipsjax.data.synth.build import assemble, hollow
from mipsjax.data.synth.catalog import FPS, QVGA, SPECS
from mipsjax.data.synth.corridors import RING, STAIR, legs
from mipsjax.data.synth.cull import SHADING_REACH, in_view, is_large, nearby
from mipsjax.data.synth.furniture import Piece, crate, together
from mipsjax.data.synth.mesh import reference_mesh
from mipsjax.data.synth.path import speeds
from mipsjax.data.synth.render import pixel_rays, trace
from mipsjax.data.synth.rooms import PAINTS, living_room
from mipsjax.data.synth.scene import Scene
from mipsjax.data.synth.walk import Gait, walk

pytestmark = pytest.mark.slow

ALL = slice(None)
SMALL = QVGA.resized(64, 48)
LARGE = ("apartment", "corridor-loop", "no-loop")
# Depth cameras measure little beyond; nearer than the lower limit they measure nothing
NEAR, FAR = 0.4, 5.0

distance = jax.jit(lambda scene, points: scene.distance(points))
# Ranges without colour compile fast; the lights of one scene, so that all three share the compiled code
traced = jax.jit(lambda scene, pose: trace(scene, pixel_rays(pose, jnp.array(SMALL[:4]), 48, 64)))
color_of = jax.jit(lambda scene, points: scene.color(points))


@lru_cache(maxsize=3)
def poses(name: str) -> np.ndarray:
    T_world_cam = open_synth(name, ALL, InputConfig()).T_world_cam
    assert T_world_cam is not None
    return T_world_cam


def depth_of(scene: Scene, T_world_cam: np.ndarray) -> np.ndarray:
    """What a small camera measures, to within 0.2 mm."""
    part = in_view(scene, SMALL, T_world_cam)._replace(lights=living_room().lights)
    return np.asarray(traced(part, jnp.asarray(T_world_cam, jnp.float32))).reshape(48, 64)


def least_constraint(depth: np.ndarray, k: Intrinsics) -> float:
    """Smallest eigenvalue of the mean of J^T J of point-to-plane residuals, J = (normal, point x normal).

    Points about their mean, in units of their root mean square distance from it. Normals by central
    differences, where inverse depth is nearly linear over the image.
    """
    v, u = np.mgrid[: k.height, : k.width]
    ray = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    p, inverse = ray * depth[..., None].astype(np.float64), 1.0 / depth
    normal = np.cross(p[1:-1, 2:] - p[1:-1, :-2], p[2:, 1:-1] - p[:-2, 1:-1])
    bend = np.maximum(
        np.abs(np.diff(inverse, n=2, axis=0))[:, 1:-1], np.abs(np.diff(inverse, n=2, axis=1))[1:-1]
    )
    middle = p[1:-1, 1:-1]
    smooth = (bend * middle[..., 2] < 0.02) & (middle[..., 2] > NEAR) & (middle[..., 2] < FAR)
    points, normals = middle[smooth], normal[smooth]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = points - points.mean(axis=0)
    points /= np.sqrt(np.mean(np.sum(points**2, axis=1)))
    rows = np.concatenate([normals, np.cross(points, normals)], axis=1)
    return float(np.linalg.eigvalsh(rows.T @ rows / len(rows))[0])


def looking_along(place: tuple[float, float, float]) -> np.ndarray:
    """A camera that looks along +z."""
    T_world_cam = np.eye(4)
    T_world_cam[:3, 3] = place
    return T_world_cam


# What every view offers

# A bare corridor has 4e-6 at this image size (its rounding) and the weakest views of the living room 0.015
CONSTRAINED = 0.003


def test_a_bare_corridor_does_not_constrain() -> None:
    bare = assemble(
        PAINTS, [hollow((-1.2, -9.0), (1.2, 9.0), 0.0, 2.6, ("parquet", "plaster", "ceiling"))], [], [], []
    )
    depth = depth_of(bare, looking_along((0.2, -1.4, 0.0)))
    assert least_constraint(depth, SMALL) < 1e-2 * CONSTRAINED


@pytest.mark.parametrize("name", LARGE)
def test_depth_constrains_all_six_degrees_of_freedom(name: str) -> None:
    found = {
        frame: least_constraint(depth_of(SPECS[name].scene(), poses(name)[frame]), SMALL)
        for frame in range(0, SPECS[name].frames, 15)
    }
    worst = min(found, key=lambda frame: found[frame])
    assert found[worst] > CONSTRAINED, f"frame {worst}"


@pytest.mark.parametrize("name", LARGE)
def test_walks_keep_clear_of_surfaces(name: str) -> None:
    places = jnp.asarray(poses(name)[:, :3, 3], jnp.float32)
    assert np.min(distance(SPECS[name].scene(), places)) > 0.3


@pytest.mark.parametrize("name", LARGE)
def test_surfaces_are_textured(name: str) -> None:
    scene = SPECS[name].scene()
    places = poses(name)[::40, :3, 3]
    points = places + np.random.default_rng(1).uniform(-1.5, 1.5, places.shape)
    color = np.asarray(color_of(scene, jnp.asarray(points, jnp.float32)))
    assert color.min() >= 0.0 and color.max() <= 1.0 and np.all(color.std(axis=0) > 0.05)


# Walks


@pytest.mark.parametrize(
    ("name", "linear", "turn_deg"),
    [("apartment", (0.5, 0.8), 40.0), ("corridor-loop", (0.8, 1.5), 60.0), ("no-loop", (0.8, 1.5), 60.0)],
)
def test_walking_speeds(name: str, linear: tuple[float, float], turn_deg: float) -> None:
    found, turning = speeds(poses(name), 1.0 / FPS)
    assert linear[0] <= found.min() and found.max() <= linear[1]
    assert np.degrees(turning.max()) <= turn_deg


@pytest.mark.parametrize(
    ("name", "around_m", "again_m"), [("apartment", 30.0, 1.0), ("corridor-loop", 60.0, 3.0)]
)
def test_loops_close_and_go_on(name: str, around_m: float, again_m: float) -> None:
    """The end of the walk is its beginning, in the same direction: to about a frame's motion."""
    path, found = SPECS[name].path(), poses(name)
    length = np.cumsum(speeds(found, 1.0)[0])
    back = round(path.duration * FPS)
    assert length[back - 1] >= around_m and length[-1] - length[back - 1] >= again_m
    repeated = found[back:]
    assert np.max(np.linalg.norm(repeated[:, :3, 3] - found[: len(repeated), :3, 3], axis=1)) < 0.03
    turned = np.einsum("nij,nij->n", repeated[:, :3, :3], found[: len(repeated), :3, :3])
    assert np.degrees(np.arccos(np.clip((turned.min() - 1.0) / 2.0, -1.0, 1.0))) < 2.0


def test_control_never_returns() -> None:
    """Places more than 12 m apart along the walk are more than 8 m apart."""
    places = poses("no-loop")[::10, :3, 3]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert along[-1] > 40.0
    assert np.min(apart[np.abs(along[:, None] - along[None]) > 12.0]) > 8.0


def test_stretches_of_the_control_look_alike_but_not_quite() -> None:
    """Depth from the same place of the first and of the third leg, which point the same way."""
    scene, (first, _, third, _) = SPECS["no-loop"].scene(), legs(STAIR, closed=False)
    images = [
        depth_of(scene, looking_along((x, -1.45, z)))
        for x, z in (first.point(3.0, 0.0), third.point(3.0, 0.0))
    ]
    near = (images[0] < FAR) & (images[1] < FAR)
    difference = np.abs(images[0] - images[1])[near]
    # Most pixels see floor, ceiling and walls, which agree
    assert np.median(difference) < 0.02 and np.mean(difference > 0.05) > 0.1


def test_apartment_needs_many_submaps() -> None:
    """Boxes of at most 7 m a side, filled in order of time with less than what is seen: 3 m ahead only."""
    centers, ahead = poses("apartment")[:, :3, 3], poses("apartment")[:, :3, 2]
    boxes, low, high = 1, np.full(3, np.inf), np.full(3, -np.inf)
    for center, axis in zip(centers, ahead, strict=True):
        ends = np.stack([center - 0.5 * axis, center + 3.0 * axis])
        low, high = np.minimum(low, ends.min(axis=0)), np.maximum(high, ends.max(axis=0))
        if np.max(high - low) > 7.0:
            boxes, low, high = boxes + 1, ends.min(axis=0), ends.max(axis=0)
    assert boxes >= 6


def test_walk_follows_its_line() -> None:
    gait = Gait(corner=0.3, ahead=2.0, look_aside=0.0, look_every=6.0, aside=0.0, height=(1.4, 0.0))
    places, targets = walk(((0.0, 0.0), (0.0, 10.0)), gait, closed=False)
    np.testing.assert_allclose(places[:, :2], np.tile([0.0, -1.4], (len(places), 1)), atol=1e-12)
    assert np.all(np.diff(places[:, 2]) > 0.5) and 9.0 < np.ptp(places[:, 2]) < 10.0
    # Samples of the line are 5 cm apart; its ends are drawn in by the rounding
    np.testing.assert_allclose((targets - places)[1:-1, 2], 2.0, atol=0.1)


# Parts of a scene


@pytest.mark.parametrize("name", LARGE)
@pytest.mark.parametrize("share", [0.03, 0.36, 0.71])
def test_culled_view_is_the_view(name: str, share: float) -> None:
    """Rays traced in the part run in free space of the whole scene, and end on its surface."""
    scene, pose = SPECS[name].scene(), poses(name)[int(share * SPECS[name].frames)]
    part = in_view(scene, SMALL, pose)
    assert len(part.boxes.rounding) < len(scene.boxes.rounding)
    depth, v_u = depth_of(scene, pose), np.mgrid[: SMALL.height, : SMALL.width]
    sight = np.stack(
        [(v_u[1] - SMALL.cx) / SMALL.fx, (v_u[0] - SMALL.cy) / SMALL.fy, np.ones(v_u[0].shape)], axis=-1
    )
    for fraction in np.linspace(0.05, 0.99, 24):
        p_cam = (sight * fraction * depth[..., None]).reshape(-1, 3)
        p_world = jnp.asarray(p_cam @ pose[:3, :3].T + pose[:3, 3], jnp.float32)
        assert np.min(distance(scene, p_world)) > -1e-5
    p_world = jnp.asarray((sight * depth[..., None]).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3])
    assert np.max(np.abs(distance(scene, p_world.astype(jnp.float32)))) < 5e-4


def test_small_scenes_stay_whole() -> None:
    assert not is_large(living_room())
    assert in_view(living_room(), SMALL, looking_along((0.0, -1.4, 0.0))) is living_room()


def test_what_a_doorway_shows_is_kept_and_what_a_wall_hides_is_not() -> None:
    """Crates in the next room, seen through its doorway, and behind the wall beside it."""
    faces = ("parquet", "plaster", "ceiling")
    carved = [
        hollow((-4.0, -4.0), (4.0, 0.0), 0.0, 2.6, faces),
        hollow((-4.0, 0.2), (4.0, 4.0), 0.0, 2.6, faces),
        hollow((-0.5, -0.5), (0.5, 0.7), 0.0, 2.0, faces),
    ]
    places = [(0.0, 3.0), (2.8, 1.0), (0.0, -1.5), (3.9, -3.0)]
    here = [(0.01 * n, -3.8) for n in range(70)]
    crates = together(crate((0.1, 0.1, 0.1), "oak").at(place) for place in (*places, *here))
    scene = assemble(PAINTS, carved, crates.boxes, [], [])
    part = in_view(scene, SMALL, looking_along((0.0, -1.4, -3.0)))
    kept = {tuple(np.round(row[[0, 2]], 2).tolist()) for row in np.asarray(part.boxes.center)}
    assert [place in kept for place in places] == [True, False, True, False]


def test_nearby_part_has_the_same_surface() -> None:
    low = np.array([5.0, 4.5])
    part = nearby(apartment(), low, low + 2.0)
    offsets = np.random.default_rng(3).uniform(0.0, 1.0, (3000, 3)) * [2.0, 2.6, 2.0]
    points = jnp.asarray(np.array([low[0], -2.6, low[1]]) + offsets, jnp.float32)
    whole, local = np.asarray(distance(apartment(), points)), np.asarray(distance(part, points))
    close = np.abs(whole) < SHADING_REACH
    np.testing.assert_allclose(local[close], whole[close], atol=1e-6)
    np.testing.assert_array_equal(np.sign(local), np.sign(whole))


def test_pieces_turn_as_they_are_told() -> None:
    """A piece at the origin that faces +z faces +x when turned by 90 degrees."""
    front = Piece((crate((0.4, 0.3, 0.2), "oak").boxes[0]._replace(center=(0.0, -0.15, 1.0)),))
    (solid,) = front.at((2.0, 3.0), 90.0, lift=0.5).boxes
    np.testing.assert_allclose(solid.center, (3.0, -0.65, 3.0), atol=1e-12)
    assert solid.turn_deg == 90.0


def test_legs_face_the_middle() -> None:
    """From the right of a leg along +x, which is at -z, pieces face +z."""
    leg = legs(RING, closed=True)[1]
    np.testing.assert_allclose(leg.point(1.0, 1.2), (1.0, 10.8))
    assert leg.turn_deg(1.0) == 0.0 and abs(leg.turn_deg(-1.0)) == 180.0
    assert leg.turn_deg(0.0) == -90.0


# Mesh, sensor


def test_mesh_is_on_the_surface_and_reaches_the_bounds() -> None:
    built = SPECS["no-loop"].scene()
    mesh = reference_mesh(built, voxel_m=0.12)
    off = np.abs(distance(built, jnp.asarray(mesh.vertices, jnp.float32)))
    # Cells of 12 cm hold several creases of a chair's leg, and there a correction may miss
    assert np.quantile(off, 0.98) < 1e-4 and np.max(off) < 0.03
    np.testing.assert_allclose(mesh.bounds, np.asarray(built.bounds), atol=0.02)


def test_noise_is_on_demand() -> None:
    config = InputConfig(working_width=80)
    exact, noisy = (open_synth(name, slice(9, 10), config)[0].depth for name in ("no-loop", "no-loop+noise"))
    assert exact is not None and noisy is not None
    assert np.mean(exact == 0.0) < 0.1 < np.mean(noisy != exact)
